"""Shifted zeros as the other joints feel them."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.reduction import Reduction
from nerf2real.sysid.selection.joints import changes, subject
from nerf2real.sysid.selection.wider import scopes, zeros
from nerf2real.sysid.selection.wider.wide import ZERO
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.selection.joints.test_changes import few
from tests.sysid.synthetic import ARM, log_of

# Both joints turn about one axis, and the lower link is heavy: where the elbow is misread, the link
# hangs elsewhere than the shoulder is told.
CHAIN = """
<mujoco model="chain">
  <option timestep="0.001" integrator="implicitfast"/>
  <default><joint axis="0 1 0" damping="0.6" armature="0.03" frictionloss="0.02"/></default>
  <worldbody><body name="upper">
    <joint name="shoulder"/>
    <inertial pos="0 0 -0.1" mass="0.4" diaginertia="1e-3 1e-3 2e-4"/>
    <body name="lower" pos="0 0 -0.2">
      <joint name="elbow"/>
      <inertial pos="0 0 -0.15" mass="0.8" diaginertia="8e-4 8e-4 1e-4"/>
    </body>
  </body></worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="30" forcerange="-8 8"/>
    <position name="elbow" joint="elbow" kp="8" forcerange="-6 6"/>
  </actuator>
</mujoco>"""
SHIFT = 0.08
SHIFTED = Effect("encoder_offset", "elbow", {"offset": SHIFT})


@pytest.fixture(scope="module")
def machine():
  """The model, its logs, the shoulder as explained beside the misread elbow, and the elbow."""
  model = mujoco.MjModel.from_xml_string(CHAIN)
  logs = [log_of(CHAIN, kind, [SHIFTED], duration=5.0) for kind in ("sweep", "slow")]
  machine = Machine(model, logs)
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(subject, "own_library", few)
    shoulder = changes.explain(
      subject.prepare("shoulder", machine, None, tried=2, settings=SETTINGS)
    )
  return model, logs, shoulder, misread(SHIFT)


def misread(offset: float) -> SimpleNamespace:
  """An elbow of which a shifted zero is named, beside another joint's."""
  term = Term(ZERO, "elbow", ("offset",), (-1.0,), (1.0,), (1.0,), ((0.0,),))
  other = Term(ZERO, "wrist", (), (), (), (), ((),), fixed=(("offset", 0.5),), known=True)
  fit = SimpleNamespace(values=lambda of: {"offset": {term: offset}[of]})
  best = SimpleNamespace(terms=(other, term), fit=fit)
  return SimpleNamespace(joint="elbow", named=(ZERO,), found=SimpleNamespace(best=best))


def test_a_joint_is_explained_anew_beside_another_that_was_misread(machine):
  model, _, shoulder, elbow = machine
  state, before = shoulder.subject.state, shoulder.subject.left
  again, kept = zeros.reread(model, [shoulder, elbow], SETTINGS)
  after, shoulder.subject.state = again.subject.left, state
  assert kept is elbow
  assert after < 0.55 * before
  assert again.verdict == "none" != shoulder.verdict


def test_what_another_zero_does_not_change_stays(machine):
  model, _, shoulder, _ = machine
  elbow = misread(1e-6)
  assert zeros.reread(model, [shoulder, elbow], SETTINGS) == [shoulder, elbow]


def test_without_a_named_zero_nothing_is_explained_anew(machine):
  model, _, shoulder, _ = machine
  assert zeros.reread(model, [shoulder], SETTINGS) == [shoulder]


def test_what_another_zero_adds_is_what_the_right_readings_show(machine):
  model, logs, *_ = machine
  position = logs[0].states.position - np.array([0.0, SHIFT])
  right = dataclasses.replace(logs[0].states, position=position)
  detailed = Reduction(model, logs[0]).detailed  # the same but for the elbow's place
  moved = dataclasses.replace(detailed, position=detailed.position - np.array([0.0, SHIFT]))
  log = dataclasses.replace(logs[0], states=right)
  plant = JointModel(model, "shoulder", [logs[0]], reductions=[Reduction(model, logs[0])])
  other = Reduction(model, log, motion=moved)
  want = JointModel(model, "shoulder", [log], reductions=[other]).forces((), 0)
  got = plant.forces([plant.zero_load("elbow", SHIFT)], 0)
  for before, mine, true in zip(plant.forces((), 0), got, want, strict=True):
    change = np.abs(true - before).max()
    np.testing.assert_allclose(mine, true, atol=0.01 * change)


@pytest.mark.parametrize("joint", ["shoulder", "elbow"])
def test_a_zero_at_its_true_size_leaves_nothing_at_a_joint_of_its_chain(joint):
  effect = Effect("encoder_offset", "elbow", {"offset": 0.15})
  log = log_of(ARM, "sweep", [effect], duration=4.0, rounding=0.0)
  plant = JointModel(mujoco.MjModel.from_xml_string(ARM), joint, [log])
  term = Term("encoder_offset", "elbow", (), (), (), (), ((),), fixed=(("offset", 0.15),))
  left = []
  for terms in ((term,), ()):
    composed = compose(plant, terms, np.zeros(0))
    course = plant.run(composed.p, composed.loads, 0).position
    left.append(np.sqrt(np.mean((course - plant.logs[0].position)[100:] ** 2)))
  assert left[0] < 2e-4 < 2e-3 < left[1]


def test_a_zero_is_named_by_what_the_joint_before_it_feels():
  model = mujoco.MjModel.from_xml_string(CHAIN)
  far = Effect("encoder_offset", "elbow", {"offset": 0.18})  # less is a payload as well as a zero
  logs = [log_of(CHAIN, kind, [far], duration=8.0) for kind in ("sweep", "steps", "slow")]
  machine = Machine(model, logs)
  subjects = [
    subject.prepare(j, machine, None, tried=2, settings=SETTINGS) for j in ("shoulder", "elbow")
  ]
  (found,) = scopes.shared_effects(model, subjects, SETTINGS)
  assert (found.term.kind, found.term.target) == (ZERO, "elbow")
  assert found.x[0] == pytest.approx(0.18, abs=0.003)


@pytest.mark.parametrize(
  ("tilt", "reach", "zero"),
  [
    ((0.0, 0.05), 0.01, ("shoulder", 0.05)),
    ((0.004, -0.05), 0.01, ("shoulder", -0.05)),  # upright about the other axis, by its interval
    ((0.05, 0.05), 0.01, None),
  ],
)
def test_a_tilt_about_the_axis_that_carries_all_is_a_shifted_zero(tilt, reach, zero):
  model = mujoco.MjModel.from_xml_string(CHAIN)
  bounds = {n: (v - reach, v + reach) for n, v in zip("xy", tilt, strict=True)}
  found = zeros.of_tilt(model, np.array(tilt), bounds)
  if zero is None:
    assert found is None
  else:
    joint, offset, interval = found
    assert (joint, offset) == (zero[0], pytest.approx(zero[1]))
    assert interval == pytest.approx((offset - reach, offset + reach))


def test_a_machine_of_several_chains_or_an_upright_axis_is_tilted():
  bounds = {n: (0.04, 0.06) for n in "xy"}
  two = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody>"
    + 2 * '<body><joint axis="0 1 0"/><geom size="0.1"/></body>'
    + "</worldbody></mujoco>"
  )
  assert zeros.of_tilt(two, np.array([0.0, 0.05]), bounds) is None
  torso = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body>"
    + 2 * '<body><joint axis="0 1 0"/><geom size="0.1"/></body>'
    + "</body></worldbody></mujoco>"
  )
  assert zeros.of_tilt(torso, np.array([0.0, 0.05]), bounds) is None
  upright = mujoco.MjModel.from_xml_string(CHAIN.replace('axis="0 1 0"', 'axis="0 0 1"'))
  assert zeros.of_tilt(upright, np.array([0.0, 0.05]), bounds) is None


def test_a_shifted_zero_moves_a_chain_as_a_tilt_does():
  tilted = [Effect("gravity_tilt", None, {"x": 0.0, "y": 0.05})]
  shifted = [Effect("encoder_offset", "shoulder", {"offset": 0.05})]
  model, log = mujoco.MjModel.from_xml_string(CHAIN), log_of(CHAIN, "sweep", duration=4.0)
  courses = [simulation.simulate(model, log, effects) for effects in (tilted, shifted, [])]
  apart = [np.sqrt(np.mean((courses[0] - other)[100:] ** 2)) for other in courses[1:]]
  assert apart[0] < 0.05 * apart[1]
