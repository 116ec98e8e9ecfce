"""Names of what changed since a reference: one rule, and a machine that had something before."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.selection import analysis
from nerf2real.sysid.selection.joints import (
  changes,
  doubts,
  leaving,
  naming,
  remainder,
  subject,
)
from nerf2real.sysid.selection.search import rivals
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import COUNT, PENDULUM, log_of, logs_of

KINDS = ("command_delay", "viscous_friction", "coulomb_friction", "payload")


def few(plant, **_):
  """Returns a library that a test has the time for."""
  return [t for t in candidates.library(plant) if t.kind in KINDS]


BEFORE = [Effect("coulomb_friction", "joint", {"torque": 0.15})]


def _leaving(square, strained=False):
  fit = SimpleNamespace(residuals=[np.full((1, 20), np.sqrt(square))])
  return SimpleNamespace(fit=fit, is_strained=lambda _: strained)


def _explainer():
  joint = SimpleNamespace(log_of=np.zeros(20), squares=np.square)
  return SimpleNamespace(joint=joint, settings=SETTINGS)


def test_constants_that_are_strained_may_hide_an_effect():
  def left(*_):
    return False

  judged = SimpleNamespace(usual=None, paired=False)
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(leaving, "leaves", left)
    assert not leaving.may_leave(judged, _leaving(1.0, strained=False), SETTINGS)
    assert leaving.may_leave(judged, _leaving(1.0, strained=True), SETTINGS)


@pytest.fixture(scope="module")
def found():
  """Reports of a machine with friction of old: unchanged, and with commands late since."""
  patch = pytest.MonkeyPatch()
  patch.setattr(subject, "own_library", few)
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  late = Effect("command_delay", "joint", {"delay": 0.02})

  def logs(effects):
    return [
      log_of(PENDULUM, kind, effects, duration=5.0, seed=i)
      for i, kind in enumerate(("sweep", "steps"))
    ]

  before = logs(BEFORE)
  result = {
    "same": analysis.analyse(model, logs(BEFORE), before),
    "late": analysis.analyse(model, logs([*BEFORE, late]), before),
  }
  patch.undo()
  return result


def test_what_was_there_before_is_no_change(found):
  assert found["same"].verdict == "none"
  assert found["same"].effects == []


def test_what_changed_is_named_with_its_size(found):
  result = found["late"]
  assert result.verdict == "effects"
  (row,) = result.effects
  assert (row["kind"], row["joint"]) == ("command_delay", "joint")
  assert row["parameters"]["delay"]["value"] == pytest.approx(0.02, abs=0.002)
  assert row["evidence"]["clear_by_standard_errors"] > naming.thresholds(len(KINDS))[0]


def test_the_report_lists_what_was_there_before(found):
  # Dry friction of 0.15 N m is in both: it is in the extended model, and no change.
  result = found["late"]
  kinds = {row["kind"] for row in result.in_reference}
  assert kinds <= {"coulomb_friction", "viscous_friction", "payload"}
  assert {e.kind for e in result.objects} >= {"command_delay", *kinds}


@pytest.mark.parametrize(("delay", "verdict"), [(0.02, "unexplained"), (0.0, "none")])
def test_a_size_that_constants_leave_open_is_not_nothing(monkeypatch, delay, verdict):
  """A late command of 9 ms: latency and skew at their bounds may be most of it, and no name is
  certain, but the declared model is clearly worse."""
  monkeypatch.setattr(subject, "own_library", few)
  monkeypatch.setattr(changes, "is_something", lambda *_: False)
  late = [Effect("command_delay", "joint", {"delay": delay})] if delay else []
  logs = [
    log_of(PENDULUM, kind, late, duration=5.0, seed=i) for i, kind in enumerate(("sweep", "steps"))
  ]
  found = analysis.analyse(mujoco.MjModel.from_xml_string(PENDULUM), logs)
  assert (found.verdict, found.effects) == (verdict, [])


def test_a_rotor_of_twice_the_inertia_since_the_reference_is_named(monkeypatch):
  monkeypatch.setattr(subject, "own_library", few)
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  heavier = Effect("parameter_error", "joint", {"armature": 1.9})
  logs, before = (
    [log_of(PENDULUM, k, e, duration=5.0, seed=s + i) for i, k in enumerate(("sweep", "steps"))]
    for e, s in (([heavier], 0), ([], 10))
  )
  found = analysis.analyse(model, logs, before)
  assert found.verdict == "effects"
  (row,) = found.effects
  assert row["kind"] == "parameter_error"
  assert row["parameters"]["armature"]["value"] == pytest.approx(1.9, rel=0.03)
  assert row["parameters"]["damping"]["value"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
  ("torque", "rougher", "days", "more"),
  [(0.03, 1.0, 0, True), (0.03, 1.0, 3, True), (0.0, 1.2, 3, False)],
)
def test_a_machine_of_another_session_differs_as_its_constants_do(torque, rougher, days, more):
  """A wave of torque over position, which no constant makes, or more dry friction, which one does,
  since references of the same motions: only the first remains when constants are fitted."""
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  wave = Effect("cogging", "joint", {"amplitude": torque, "periods": 8.0, "phase": 0.0})
  before = [dataclasses.replace(log, start_ns=-days * 86_400 * 10**9) for log in logs_of(PENDULUM)]
  friction = f'frictionloss="{0.03 * rougher}"'
  logs = logs_of(PENDULUM.replace('frictionloss="0.03"', friction), [wave] if torque else [])
  machines = Machine(model, logs), Machine(model, before)
  found = subject.prepare("joint", *machines, tried=1, settings=SETTINGS)
  assert found.paired and found.another_session == (days > 0)
  assert leaving.leaves(found, found.explainer.null, SETTINGS) == more


_FINE = COUNT / 4  # rad, of an encoder that shows a millisecond


def _with_ticks(nominal, tick, random):
  """A log whose commands each wait for the firmware, up to a tick [s], with a fine encoder."""
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  sent = nominal.commands
  arrives = sent.stamp + tick * random.random(len(sent.stamp))
  heard = dataclasses.replace(nominal, commands=dataclasses.replace(sent, stamp=arrives))
  position = np.round(evaluation.simulate(model, heard, []) / _FINE) * _FINE
  return dataclasses.replace(nominal, states=dataclasses.replace(nominal.states, position=position))


@pytest.mark.parametrize(("tick", "more"), [(1e-3, False), (5e-3, True)])
def test_a_command_waits_for_the_firmwares_tick(tick, more):
  """Two recordings in one session, whose commands meet other ticks, the later one longer ones."""
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  random = np.random.default_rng(0)
  logs, before = (
    [_with_ticks(log, longest, random) for log in logs_of(PENDULUM)[:2]] for longest in (tick, 1e-3)
  )
  machines = Machine(model, logs), Machine(model, before)
  found = subject.prepare("joint", *machines, tried=1, settings=SETTINGS)
  assert found.paired and not found.another_session
  assert leaving.leaves(found, found.explainer.null, SETTINGS) == more


def test_a_misfit_in_few_blocks_remains():
  blocks = np.ones(30)
  joint = SimpleNamespace(log_of=np.repeat([0, 1], 15))
  assert remainder.mean_left(joint, blocks) == 1.0
  blocks[[3, 20]] = 500.0  # a knock in each log
  assert remainder.mean_left(joint, blocks) == 1.0
  blocks[[5, 8, 25]] = 40.0  # a detent that is passed thrice
  assert remainder.mean_left(joint, blocks) > SETTINGS.more**2 > np.median(blocks)


@pytest.mark.parametrize(
  ("without", "strained", "bare", "stands"),
  [
    (1.3, False, 2.5, ()),
    (2.5, False, 1.3, ("cogging",)),
    (1.3, True, 2.5, ("cogging",)),  # constants that are off by more than they are stand in for it
    (1.3, True, 1.8, ()),
  ],
)
def test_where_more_remains_a_name_explains_more_than_it_leaves(
  monkeypatch, without, strained, bare, stands
):
  monkeypatch.setattr(rivals, "lacking", lambda *_: _leaving(without, strained))
  monkeypatch.setattr(doubts, "_left_bare", lambda *_: bare)
  monkeypatch.setattr(rivals, "with_force", lambda *_: None)
  monkeypatch.setattr(doubts, "clear", lambda *_: 0.0)  # no force does better
  explainer = _explainer()
  found = doubts.supported(
    explainer, _leaving(1.0), ("cogging",), 3.0, anyway=0.1, forced=["cogging"]
  )
  assert found == stands


@pytest.mark.parametrize(("free", "stands"), [(0.8, ("cogging",)), (0.2, ())])
def test_a_law_that_explains_nearly_all_that_a_force_does_stands(monkeypatch, free, stands):
  monkeypatch.setattr(rivals, "lacking", lambda *_: _leaving(9.0))
  monkeypatch.setattr(rivals, "with_force", lambda *_: _leaving(free))
  monkeypatch.setattr(doubts, "clear", lambda *_: 5.0)  # the force does clearly better
  found = doubts.supported(
    _explainer(), _leaving(1.0), ("cogging",), 3.0, anyway=0.1, forced=["cogging"]
  )
  assert found == stands


@pytest.mark.parametrize(("strained", "stands"), [(False, ("payload",)), (True, ())])
def test_constants_that_are_off_are_so_beside_a_force_too(monkeypatch, strained, stands):
  """What a name does beside a force where constants are held, constants that are off do as well."""
  freed = object()
  monkeypatch.setattr(rivals, "lacking", lambda *_: _leaving(9.0))
  monkeypatch.setattr(rivals, "with_freed", lambda *_: freed)
  monkeypatch.setattr(rivals, "with_force", lambda _, item: item)
  monkeypatch.setattr(doubts, "clear", lambda item, _: 1.0 if item is freed else 5.0)
  best = _leaving(1.0, strained)
  found = doubts.supported(_explainer(), best, ("payload",), 3.0, anyway=0.1, forced=["payload"])
  assert found == stands


def test_each_of_several_names_is_tried_beside_a_force(monkeypatch):
  tried = []
  monkeypatch.setattr(rivals, "lacking", lambda *_: _leaving(9.0))
  monkeypatch.setattr(rivals, "with_force", lambda _, item, *__: tried.append(item))
  monkeypatch.setattr(doubts, "clear", lambda *_: 0.0)
  explainer = _explainer()
  kinds = ("payload", "backlash")
  found = doubts.supported(explainer, _leaving(1.0), kinds, 3.0, anyway=0.1, forced=kinds)
  assert found == () and len(tried) == 4


@pytest.mark.parametrize(("observations", "follows"), [(0.2, True), (5.0, False)])
def test_a_machine_whose_courses_stray_for_long_is_judged_from_each_reading_on(
  monkeypatch, observations, follows
):
  monkeypatch.setattr(subject, "own_library", few)
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  logs = [log_of(PENDULUM, "sweep", duration=3.0, seed=s) for s in (0, 1)]
  strayed = JointLikelihood.rescale

  def rescale(joint, residuals):
    strayed(joint, residuals)
    joint.observations[:] = observations

  monkeypatch.setattr(JointLikelihood, "rescale", rescale)
  machines = Machine(model, logs[:1]), Machine(model, logs[1:])
  found = subject.prepare("joint", *machines, tried=1, settings=SETTINGS)
  assert found.now.follows == found.before.follows == follows


class _Machine:
  """A joint whose actuator has a largest torque, and whose motion took 1 N m."""

  def __init__(self, limit):
    self.declared = np.zeros(len(INDEX))
    self.declared[INDEX["highest"]] = limit

  @staticmethod
  def declared_torque():
    return np.ones(3)


@pytest.mark.parametrize(("limit", "amplitude"), [(2.0, 0.625), (25.0, 6.25), (np.inf, 0.625)])
def test_values_stay_within_what_is_plausible_for_the_machine(limit, amplitude):
  waves = candidates.Term(
    "cogging",
    "joint",
    ("amplitude", "periods", "phase"),
    (0.0, 3.0, -10.0),
    (50.0, 300.0, 10.0),
    (0.1, 0.05, 0.3),
    ((0.1, 216.0, 0.0), (0.1, 40.0, 0.0)),
  )
  term = plausible(waves, _Machine(limit))
  assert term.high == pytest.approx((amplitude, 125.0, 10.0))
  assert term.starts == ((0.1, 125.0, 0.0), (0.1, 40.0, 0.0))


def _named(clear, calls):
  """Returns a joint's finding that names what is clear by so many standard errors, and how anew."""

  def judged(subject, *_):
    calls.append(subject.sharing)
    named = ("load_friction",) if clear > naming.thresholds(20, subject.sharing)[0] else ()
    return SimpleNamespace(
      subject=subject, named=named, ranked=[], likelihood=SimpleNamespace(follows=False), own=judged
    )

  return judged(SimpleNamespace(sharing=20.0))


@pytest.mark.parametrize(
  ("clear", "named"),
  [
    ([3.2] * 20, 0),  # none is clear among twenty joints
    ([5.0] + [3.2] * 19, 1),  # one is as many as before
    ([5.0, 5.0, 3.5, 3.2, 3.2] + [1.0] * 15, 3),  # two say that a third is none by chance
    ([3.7, 3.7, 3.5, 3.4, 3.3, 3.25, 3.2] + [1.0] * 13, 7),
  ],
)
def test_names_of_many_joints_are_judged_together(monkeypatch, clear, named):
  calls: list[float] = []
  found = [_named(z, calls) for z in clear]
  by_subject = {id(c.subject): c.own for c in found}
  monkeypatch.setattr(changes, "judged", lambda subject, *_: by_subject[id(subject)](subject))
  first = sum(bool(c.named) for c in found)
  told = changes.judge_together(found)
  assert sum(bool(c.named) for c in told) == named
  assert first > 1 or set(calls) == {20.0}
