"""Play in a gear: a course that does not repeat is judged by a state that follows the readings."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.selection.analysis import analyse
from nerf2real.sysid.selection.joints import changes, naming, subject
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.selection.joints.test_changes import KINDS
from tests.sysid.synthetic import COUNT, PENDULUM, log_of, logs_of

_PLAY = {"gap": 0.03, "stiffness": 800.0, "damping": 0.3, "encoder_on_motor": 0.0}


def _play(plant: JointModel):
  return next(t for t in candidates.library(plant) if t.kind == "backlash")


def test_a_state_that_follows_comes_back_to_a_course_that_does_not_repeat() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  bouncing = _PLAY | {"gap": 0.05, "stiffness": 1000.0, "damping": 0.2}
  log = log_of(PENDULUM, "sweep", [Effect("backlash", "joint", bouncing)], duration=12.0)
  plant = JointModel(model, "joint", [log])
  late = log.states.stamp > 6.0

  def error(plant: JointModel, *, follow: bool) -> float:
    term = _play(plant)
    c = compose(plant, [term], np.array([bouncing[name] for name in term.names]))
    plant.windows[0].position[0] = log.states.position[0, 0] + 1e-4
    position = plant.run(c.p, c.loads, 0, follow=follow).position
    return float(np.sqrt(np.mean((position - log.states.position[:, 0])[late] ** 2)))

  strayed = error(plant, follow=False)
  assert strayed > 5 * COUNT
  assert error(plant, follow=True) < 0.5 * strayed


def test_stale_readings_are_not_followed() -> None:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "sweep", duration=4.0)
  moved = np.abs(np.gradient(log.states.position[:, 0])) > 4 * COUNT
  kept = np.flatnonzero(moved)[:-1:2]
  log.states.position[kept + 1] = log.states.position[kept]
  plant = JointModel(model, "joint", [log])
  stale = ~plant.logs[0].valid
  assert stale.sum() > 10
  truth = JointModel(model, "joint", [log_of(PENDULUM, "sweep", duration=4.0)])
  got = plant.run(plant.declared, (), 0, follow=True).position
  want = truth.logs[0].position
  assert np.abs(got - want)[1:].max() < 5 * COUNT  # and not the steps of stale readings


@pytest.fixture
def model(monkeypatch):
  """The pendulum, and a library that a test has the time for."""
  kinds = (*KINDS, "backlash")
  library = subject.own_library
  monkeypatch.setattr(
    subject, "own_library", lambda *a, **k: [t for t in library(*a, **k) if t.kind in kinds]
  )
  return mujoco.MjModel.from_xml_string(PENDULUM)


def test_play_is_named_with_its_gap(model) -> None:
  found = analyse(model, logs_of(PENDULUM, [Effect("backlash", "joint", _PLAY)], duration=6.0))
  assert found.verdict == "effects"
  (row,) = found.effects
  gap = row["parameters"]["gap"]
  assert row["kind"] == "backlash" and gap["low"] < _PLAY["gap"] < gap["high"]
  assert gap["value"] == pytest.approx(_PLAY["gap"], rel=0.15)  # courses do not repeat


def test_what_is_no_play_is_not_judged_by_following(model) -> None:
  late = Effect("command_delay", "joint", {"delay": 0.03})
  found = analyse(model, logs_of(PENDULUM, [late], duration=6.0))
  assert not found.joints[0].likelihood.follows
  assert [row["kind"] for row in found.effects] == ["command_delay"]


@pytest.mark.parametrize(
  ("likeliest", "named", "stands"),
  [
    ({"backlash"}, ("backlash",), True),
    ({"cogging"}, ("backlash",), False),  # nothing speaks of play
    ({"backlash"}, ("cogging",), False),  # the play is not what is named
  ],
)
def test_play_that_is_likeliest_but_not_clear_is_judged_from_each_reading_on(
  monkeypatch, likeliest, named, stands
) -> None:
  nothing = SimpleNamespace(names=frozenset(), neutral=False, evidence=-9.0, beside_force=False)
  best = SimpleNamespace(
    names=frozenset(likeliest), neutral=False, evidence=-1.0, beside_force=False
  )
  whole = SimpleNamespace(
    verdict="unexplained",
    ranked=[best, nothing],
    named=(),
    found=SimpleNamespace(best=nothing, names=()),
  )
  near = SimpleNamespace(verdict="effects", named=named)
  subject = SimpleNamespace(now=SimpleNamespace(follows=False))
  again = SimpleNamespace(now=SimpleNamespace(follows=True))
  monkeypatch.setattr(changes, "following", lambda _: again)
  handed = []

  def explained(of, _, also=()):
    handed.extend(also)
    return near if of is again else whole

  monkeypatch.setattr(changes, "_explained", explained)
  assert changes.explain(subject) is (near if stands else whole)
  assert handed == ([nothing, best] if "backlash" in likeliest else [])


def test_a_joint_that_is_followed_has_what_others_share_and_what_its_reference_has(model) -> None:
  load = {"mass": 0.2, "x": 0.0, "y": 0.0, "z": -0.15}
  had = [Effect("coulomb_friction", "joint", {"torque": 0.15})]
  has = [*had, Effect("payload", "arm", load)]
  logs = [logs_of(PENDULUM, effects, duration=5.0) for effects in (had, has)]
  before, now = (Machine(model, part) for part in logs)
  whole = subject.prepare("joint", now, before, tried=2, settings=SETTINGS)
  subject.explain_reference(whole, SETTINGS)
  values = tuple(load.items())
  shared = Term("payload", "arm", (), (), (), (), ((),), fixed=values, known=True)
  whole.take(shared)
  near = subject.following(whole)
  assert near.now.follows
  assert shared in near.known
  assert whole.usual.names == near.usual.names == {"coulomb_friction"}


def test_what_whole_logs_name_is_named_where_following_holds_it_too(monkeypatch) -> None:
  """From each reading on a weaker motor hardly shows; whole logs have it clear beside play."""
  clear = {kind: naming.Name(kind, 9.0, True, ()) for kind in ("supply_sag", "spring")}
  unclear = [naming.Name(kind, 1.0, False, ()) for kind in ("backlash", "supply_sag")]
  best = SimpleNamespace(
    names=frozenset({"backlash"}), neutral=False, evidence=-1.0, beside_force=False
  )
  whole, near = (
    changes.Changed(
      None,
      [best],
      naming.Explanation(best, tuple(names), 1.0, 1.0),
      kinds,
      verdict,
      1.0,
      1.0,
      False,
      False,
    )
    for names, kinds, verdict in (
      (clear.values(), tuple(clear), "partly"),
      (unclear, ("backlash",), "effects"),
    )
  )
  again = SimpleNamespace(now=SimpleNamespace(follows=True))
  monkeypatch.setattr(changes, "following", lambda _: again)
  monkeypatch.setattr(changes, "_explained", lambda of, *_, **__: near if of is again else whole)
  told = changes.explain(SimpleNamespace(now=SimpleNamespace(follows=False)))
  assert told.named == ("backlash", "supply_sag")
  assert told.found.names == (unclear[0], clear["supply_sag"])
