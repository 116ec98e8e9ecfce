"""Effects of a body and of the machine: evidence summed over joints."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.layout import CONSTANTS
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.selection import analysis
from nerf2real.sysid.selection.in_machine import in_machine
from nerf2real.sysid.selection.joints import subject
from nerf2real.sysid.selection.joints.leaving import may_leave
from nerf2real.sysid.selection.search import rivals
from nerf2real.sysid.selection.wider import scopes, wide
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.selection.joints.test_changes import few
from tests.sysid.synthetic import ARM, log_of

LATE = Effect("command_delay", None, {"delay": 0.021})
FADING = Effect("supply_sag", None, {"droop": 0.0, "fade": 0.008})
PAYLOAD = Effect("payload", "lower", {"mass": 0.25, "x": 0.0, "y": 0.02, "z": -0.12})


def _logs(effects, seed=0, xml=ARM, duration=5.0):
  return [
    log_of(xml, kind, effects, duration=duration, seed=seed + i)
    for i, kind in enumerate(("sweep", "slow", "steps"))
  ]


def _subjects(model, logs):
  machine = Machine(model, logs)
  return [
    subject.prepare(joint, machine, None, tried=2, settings=SETTINGS)
    for joint in ("shoulder", "elbow")
  ]


@pytest.fixture
def model(monkeypatch):
  monkeypatch.setattr(subject, "own_library", few)
  return mujoco.MjModel.from_xml_string(ARM)


def test_a_late_bus_is_one_effect_and_a_payload_is_its_body_s(model):
  found = analysis.analyse(model, _logs([LATE, PAYLOAD]))
  assert found.verdict == "effects"
  assert {(e["kind"], e["joint"]) for e in found.effects} == {
    ("command_delay", None),
    ("payload", "elbow"),
  }
  values = {e["kind"]: e["parameters"] for e in found.effects}
  assert values["command_delay"]["delay"]["value"] == pytest.approx(0.021, abs=0.002)
  assert values["payload"]["mass"]["value"] == pytest.approx(0.25, rel=0.15)
  assert {(e.kind, e.target) for e in found.objects if e.kind != "encoder_offset"} == {
    ("command_delay", None),
    ("payload", "lower"),
  }


def test_joints_tell_together_what_none_tells_alone(model):
  logs = _logs([FADING])
  assert not any(may_leave(s, s.explainer.null, SETTINGS) for s in _subjects(model, logs))
  found = analysis.analyse(model, logs)
  assert [(e["kind"], e["joint"]) for e in found.effects] == [("supply_sag", None)]
  fade = found.effects[0]["parameters"]["fade"]
  assert fade["low"] <= 0.008 <= fade["high"] and fade["value"] == pytest.approx(0.008, rel=0.1)
  assert [c.verdict for c in found.joints] == ["none", "none"] and found.verdict == "effects"


def test_what_is_likely_by_priors_alone_is_no_effect_that_no_joint_tells(model, monkeypatch):
  row = _row(np.zeros(20))
  alike = wide.Evidence({"shoulder": row, "elbow": row}, prior=-20.0)  # constants, off alike
  assert alike.clear > 5.0 and alike.by_logs == 0.0
  monkeypatch.setattr(wide.Evidence, "by_logs", 0.0)
  assert analysis.analyse(model, _logs([FADING])).verdict == "none"


def test_effects_of_the_machine_that_hide_each_other_are_both_there(model):
  low = Effect("supply_sag", None, {"droop": 0.0, "fade": 0.03})
  tilted = Effect("gravity_tilt", None, {"x": 0.1, "y": 0.1})
  found = analysis.analyse(model, _logs([low, tilted], duration=8.0))
  assert {(e["kind"], e["joint"]) for e in found.effects} == {
    ("supply_sag", None),
    ("gravity_tilt", None),
  }


def test_effects_are_tried_beside_each_other_with_what_joints_have_of_their_own(model):
  low = Effect("supply_sag", None, {"droop": 0.0, "fade": 0.03})
  tilted = Effect("gravity_tilt", None, {"x": 0.1, "y": 0.1})
  joints = _subjects(model, _logs([low, tilted], duration=8.0))
  explainer = joints[0].explainer
  own = explainer.extend(explainer.null, 1, "viscous_friction")[0]
  explainer.null = own
  kinds = {term.kind: term for term, _ in wide.hypotheses(model, joints)}
  of_all = wide.screened(kinds["gravity_tilt"], joints)
  of_one = wide.screened(kinds["supply_sag"], joints[1:])
  assert np.isfinite(wide.beside(of_all, of_one))
  assert explainer.null is own


def test_one_joint_s_friction_stays_its_own_beside_a_reference(model):
  rough = Effect("coulomb_friction", "shoulder", {"torque": 0.25})
  found = analysis.analyse(model, _logs([LATE, rough]), _logs([LATE], seed=10))
  assert [(e["kind"], e["joint"]) for e in found.effects] == [("coulomb_friction", "shoulder")]


@pytest.mark.parametrize("mass", [0.0, 0.03])
def test_a_load_is_new_where_a_reference_s_constants_could_undo_it(model, mass):
  heavier = ARM.replace('mass="0.4"', 'mass="0.448"').replace('mass="0.3"', 'mass="0.336"')
  load = Effect("payload", "lower", {"mass": mass, "x": 0.0, "y": 0.01, "z": -0.08})
  found = analysis.analyse(model, _logs([load], xml=heavier), _logs([], seed=10, xml=heavier))
  assert [e["kind"] for e in found.effects] == ["payload"] * (mass > 0)
  if mass:
    size = found.effects[0]["parameters"]["mass"]
    assert size["low"] <= mass <= size["high"]


def test_a_load_that_is_screened_has_left_its_start(model):
  (term, members), *_ = [
    (term, members)
    for term, members in wide.hypotheses(model, _subjects(model, _logs([PAYLOAD])))
    if (term.kind, term.target) == ("payload", "lower")
  ]
  screened = wide.screened(term, members)
  assert screened.x[0] == pytest.approx(0.25, rel=0.3)
  fitted = wide.fitted(screened).evidence().total
  assert screened.possible().total == pytest.approx(fitted, rel=0.1)


def _less(nats):
  return nats - 0.3 - (-1.0) ** np.arange(len(nats))


def test_a_scope_that_is_open_leaves_the_kind_certain(model, monkeypatch):
  def alone(item, at):
    """Returns the evidence of one joint as nearly all there is."""
    rows = item.evidence().rows
    rows = {j: row._replace(nats=_less(row.nats)) for j, row in rows.items()}
    return wide.Evidence(rows, item.evidence().prior), 1.02 * item.x

  monkeypatch.setattr(wide, "alone", alone)
  found = analysis.analyse(model, _logs([LATE]))
  assert [(e["kind"], e["joint"]) for e in found.effects] == [("command_delay", None)]
  (other,) = found.scopes
  assert other["kinds"] == ["command_delay"] and other["joint"] in ("shoulder", "elbow")
  assert 0.0 < other["evidence"]["behind_by_standard_errors"] < 3.0
  assert other["parameters"]["command_delay"]["delay"] == pytest.approx(0.021, abs=0.002)


def test_an_effect_of_the_machine_is_looked_for_beside_what_joints_have(model, monkeypatch):
  monkeypatch.setattr(scopes, "shared_effects", lambda *_, **__: [])  # hidden at first
  drift = Effect("clock_drift", None, {"rate": 0.002})
  damped = Effect("viscous_friction", "shoulder", {"coefficient": 0.8})
  found = analysis.analyse(model, _logs([drift, damped]))
  assert {(e["kind"], e["joint"]) for e in found.effects} == {
    ("clock_drift", None),
    ("viscous_friction", "shoulder"),
  }


def test_what_joints_each_have_is_one_effect_of_the_machine(model, monkeypatch):
  monkeypatch.setattr(scopes, "shared_effects", lambda *_, **__: [])  # hidden at first
  found = analysis.analyse(model, _logs([LATE]))
  assert [(e["kind"], e["joint"]) for e in found.effects] == [("command_delay", None)]
  assert found.verdict == "effects"


def _fake(joint, without):
  now = SimpleNamespace(alike=lambda apart: bool(np.abs(apart).max() < 0.1))
  null = SimpleNamespace(fit=SimpleNamespace(residuals=[np.full((1, 20), without)]))
  return SimpleNamespace(joint=joint, now=now, explainer=SimpleNamespace(null=null))


@pytest.mark.parametrize(("at_elbow", "same"), [(1.0, True), (0.5, False)])
def test_a_load_farther_out_is_the_same_where_the_joints_between_feel_nothing(at_elbow, same):
  shoulder, elbow = _fake("shoulder", 1.0), _fake("elbow", 1.0)
  near, far = (
    wide.Wide(
      Term(kind="payload", target=body, names=(), low=(), high=(), scale=(), starts=()),
      members,
      SimpleNamespace(residuals=[np.full((1, 20), left) for left in lefts]),
    )
    for body, members, lefts in (
      ("upper", (shoulder,), (0.0,)),
      ("lower", (elbow, shoulder), (at_elbow, 0.0)),
    )
  )
  assert wide.same(near, far) == wide.same(far, near) == same
  assert min([far, near], key=scopes._how_usual) is near


@pytest.mark.parametrize(("square", "stands"), [(0.1, True), (1.0, False), (9.0, False)])
def test_explanations_beside_a_further_effect_must_be_better(square, stands):
  now = SimpleNamespace(
    loglik=lambda squares: -np.log1p(squares).sum(axis=0), told_apart=_Even.told_apart
  )

  def explained(left):
    fit = SimpleNamespace(held=[np.full((1, 20), left)], residuals=[np.full((1, 20), left)])
    best = SimpleNamespace(joint=now, fit=fit, prior=0.0)
    subject = SimpleNamespace(now=now, beyond=3.0)
    return SimpleNamespace(joint="elbow", subject=subject, found=SimpleNamespace(best=best))

  assert scopes.better([explained(square)], [explained(1.0)]) == stands


def test_what_predicts_the_same_as_a_shared_effect_is_said_beside_it(model):
  term = Term("command_delay", None, ("delay",), (0.0,), (0.1,), (0.01,), ((0.0,),))
  twin = dataclasses.replace(term, kind="measurement_delay")
  joints = tuple(SimpleNamespace(joint=name) for name in ("shoulder", "elbow"))
  near = np.array([0.001])
  shared = scopes.Shared(
    *(term, np.array([0.0153]), (near, near), joints[1], joints, 4.2, 150.0),
    alike=((twin, np.array([0.0154])),),
  )
  found = SimpleNamespace(model=model, objects=[], effects=[], scopes=[], twins=[])
  analysis._write_shared(found, shared, own_latency=False)
  assert [(e["kind"], e["joint"]) for e in found.effects] == [("command_delay", None)]
  (other,) = found.twins
  assert (other["kind"], other["joint"], other["confounded"]) == ("measurement_delay", None, True)
  assert other["parameters"] == {"measurement_delay": {"delay": 0.0154}}
  assert found.scopes == []


@pytest.mark.parametrize(("joint", "unit"), [("rail", "m"), ("arm", "rad")])
def test_the_zero_of_a_slide_is_told_in_metres(joint, unit):
  model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint name='rail' type='slide'/><geom size='.1'/>"
    "<body><joint name='arm' axis='0 1 0'/><geom size='.1'/></body></body></worldbody></mujoco>"
  )
  term = Term(wide.ZERO, joint, ("offset",), (-0.1,), (0.1,), (0.01,), ((0.0,),))
  members = tuple(SimpleNamespace(joint=name) for name in ("rail", "arm"))
  near = np.array([0.001])
  shared = scopes.Shared(term, np.array([0.02]), (near, near), members[0], members, 4.2, 150.0)
  found = SimpleNamespace(model=model, effects=[], zeros={})
  analysis._write_shared(found, shared, own_latency=False)
  (row,) = found.effects
  assert row["joint"] == joint and row["parameters"]["offset"]["unit"] == unit


def test_two_healthy_joints_have_nothing(model):
  found = analysis.analyse(model, _logs([]))
  assert (found.verdict, found.effects) == ("none", [])


class _Even:
  """A joint all of whose blocks tell two hypotheses apart equally well."""

  @staticmethod
  def told_apart(apart):
    return np.full(apart.shape[-1], 0.3)


def _row(nats):
  return wide.Row(_Even, nats, np.ones((1, len(nats))), np.zeros((1, len(nats))))


def test_joints_add_up_where_each_alone_would_not_do():
  random = np.random.default_rng(0)
  rows = {f"joint_{i}": _row(random.normal(0.3, 1.0, 30)) for i in range(20)}
  alone = [wide.Evidence({joint: row}).clear for joint, row in rows.items()]
  assert np.median(alone) < 2.5 < 5.0 < wide.Evidence(rows).clear
  assert (wide.Evidence(rows) - wide.Evidence(rows)).total == 0.0


def test_a_difference_counts_joints_that_one_side_lacks():
  row = _row(np.linspace(0.9, 1.1, 10))
  both = wide.Evidence({"a": row, "b": row}, prior=2.0)
  assert both.total == pytest.approx(18.0)
  assert (both - wide.Evidence({"a": row}, prior=0.5)).total == pytest.approx(8.5)


@pytest.mark.parametrize("more_remains", [False, True])
def test_a_shared_name_stands_beside_a_free_force_where_more_remains(monkeypatch, more_remains):
  joint = SimpleNamespace(joint="elbow", beyond=3.0, explainer=None)
  nats = np.linspace(0.9, 1.1, 30)
  best, without = SimpleNamespace(nats=nats, prior=0.0), SimpleNamespace(nats=0 * nats, prior=0.0)
  monkeypatch.setattr(wide.Row, "of", lambda one, other: _row(one.nats - other.nats))
  monkeypatch.setattr(wide, "without", lambda *_: without)
  monkeypatch.setattr(rivals, "beside", lambda *_: best)  # the force does as well without the name
  shared = SimpleNamespace(joints=["elbow"], held=None, origin=joint)
  found = SimpleNamespace(best=best)
  item = SimpleNamespace(subject=joint, joint="elbow", found=found, more_remains=more_remains)
  assert scopes.needless([shared], [item]) == ([shared] if more_remains else [])


LOW = Effect("motor_gain", None, {"gain": 0.93, "scales_limit": 1.0})


@pytest.fixture
def weakened(model, monkeypatch):
  """The arm, beside whose few effects strength is looked for."""

  def with_strength(plant, **_):
    strength = [t for t in candidates.library(plant) if t.kind == "motor_gain"]
    return [*few(plant), *strength]

  monkeypatch.setattr(subject, "own_library", with_strength)
  return model


@pytest.mark.parametrize("first", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_a_low_supply_is_one_effect_of_the_machine(weakened, first):
  """Beside references with the same commands, and beside others."""
  found = analysis.analyse(weakened, _logs([LOW]), _logs([], seed=first))
  assert [(e["kind"], e["joint"]) for e in found.effects] == [("motor_gain", None)]
  gain = found.effects[0]["parameters"]["gain"]
  assert gain["low"] <= 0.93 <= gain["high"] < 1.0
  assert {(e.kind, e.target) for e in found.objects if e.kind == "motor_gain"} == {
    ("motor_gain", None)
  }


@pytest.mark.parametrize("gain", [0.992, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_supply_as_low_as_two_recordings_differ_is_none(weakened, gain):
  low = dataclasses.replace(LOW, parameters=LOW.parameters | {"gain": gain})
  found = analysis.analyse(weakened, _logs([low]), _logs([]))
  assert found.verdict == "none" and not found.effects


def test_one_weak_servo_is_no_low_supply(weakened):
  weak = Effect("motor_gain", "elbow", {"gain": 0.6, "scales_limit": 1.0})
  found = analysis.analyse(weakened, _logs([weak]), _logs([]))
  assert [(e["kind"], e["joint"]) for e in found.effects] == [("motor_gain", "elbow")]


def test_a_weak_joint_is_weak_beside_a_low_supply(weakened):
  """Factors multiply: the joint's own is tried, and written as what counts there in the suite."""
  low = Term("motor_gain", None, ("gain",), (0.05,), (3.0,), (0.1,), ((0.9,),))
  logs = _logs([])
  now, before = Machine(weakened, logs), Machine(weakened, logs)
  joint = subject.prepare("elbow", now, before, tried=2, settings=SETTINGS)
  joint.take(dataclasses.replace(low.held_at(np.array([0.9])), known=True))
  tried = [t for terms, *_ in joint.explainer._candidates(joint.explainer.null) for t in terms]
  own = next(t for t in tried if t.kind == "motor_gain" and t.names)
  bounds = {"gain": (0.4, 0.6)}
  terms = tuple(t for t in joint.known if t.kind != CONSTANTS)  # they may be off, too
  item = dataclasses.replace(joint.explainer.null, terms=terms)
  found = in_machine(own.effect(np.array([0.5]), bounds), item)
  assert found.parameters["gain"] == pytest.approx(0.45)
  assert found.intervals["gain"] == pytest.approx((0.36, 0.54))
  other = Effect("viscous_friction", "elbow", {"coefficient": 0.5})
  assert in_machine(other, item) is other


@pytest.mark.parametrize(("effects", "tried"), [([LATE], 1), ([], 2)])
def test_what_could_not_come_near_the_best_is_not_tried(model, monkeypatch, effects, tried):
  """One of the elbow alone cannot, where late commands explain the shoulder, too."""
  subjects = _subjects(model, _logs(effects))
  every = wide.hypotheses(model, subjects)
  late = next(h for h in every if h[0].kind == "command_delay")
  both = [(every[-1][0], (subjects[1],)), late]
  screened, seen = wide.screened, []
  monkeypatch.setattr(wide, "hypotheses", lambda *_: both)
  monkeypatch.setattr(scopes, "may_leave", lambda *_: True)
  monkeypatch.setattr(wide, "screened", lambda *h: seen.append(h) or screened(*h))
  scopes._next(model, subjects, SETTINGS, ())
  assert len(seen) == tried and seen[0] == late
