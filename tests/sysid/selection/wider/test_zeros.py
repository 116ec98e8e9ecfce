"""Shifted zeros as the other joints feel them."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.reduction import Reduction
from nerf2real.sysid.selection.joints import changes, subject
from nerf2real.sysid.selection.wider import zeros
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.selection.joints.test_changes import few
from tests.sysid.synthetic import log_of

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
  reductions = [Reduction(model, log) for log in logs]
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(subject, "own_library", few)
    shoulder = changes.explain(
      subject.prepare(
        model, "shoulder", logs, (), reductions=(reductions, ()), tried=2, settings=SETTINGS
      )
    )
  best = SimpleNamespace(values=lambda kind: {"offset": SHIFT} if kind == zeros.KIND else {})
  elbow = SimpleNamespace(joint="elbow", named=(zeros.KIND,), found=SimpleNamespace(best=best))
  return model, logs, shoulder, elbow


def test_a_joint_is_explained_anew_beside_another_that_was_misread(machine):
  model, logs, shoulder, elbow = machine
  again, kept = zeros.reread(model, [shoulder, elbow], SETTINGS)
  assert kept is elbow
  read = again.subject.now.plant.reductions[0].log.states.position
  assert np.allclose(logs[0].states.position[:, 1] - read[:, 1], SHIFT)
  assert np.allclose(logs[0].states.position[:, 0], read[:, 0])  # its own readings stay
  left = [float(np.median(c.null.fit.held[0][0])) for c in (again, shoulder)]
  assert left[0] < 0.3 * left[1]
  assert again.verdict == "none" != shoulder.verdict


def test_what_another_zero_does_not_change_stays(machine):
  model, _, shoulder, elbow = machine
  tiny = SimpleNamespace(values=lambda kind: {"offset": 1e-6})
  elbow = SimpleNamespace(**(vars(elbow) | {"found": SimpleNamespace(best=tiny)}))
  assert zeros.reread(model, [shoulder, elbow], SETTINGS) == [shoulder, elbow]


def test_without_a_named_zero_nothing_is_explained_anew(machine):
  model, _, shoulder, _ = machine
  assert zeros.reread(model, [shoulder], SETTINGS) == [shoulder]


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
  upright = mujoco.MjModel.from_xml_string(CHAIN.replace('axis="0 1 0"', 'axis="0 0 1"'))
  assert zeros.of_tilt(upright, np.array([0.0, 0.05]), bounds) is None


def test_a_shifted_zero_moves_a_chain_as_a_tilt_does():
  tilted = [Effect("gravity_tilt", None, {"x": 0.0, "y": 0.05})]
  shifted = [Effect("encoder_offset", "shoulder", {"offset": 0.05})]
  model, log = mujoco.MjModel.from_xml_string(CHAIN), log_of(CHAIN, "sweep", duration=4.0)
  courses = [simulation.simulate(model, log, effects) for effects in (tilted, shifted, [])]
  apart = [np.sqrt(np.mean((courses[0] - other)[100:] ** 2)) for other in courses[1:]]
  assert apart[0] < 0.05 * apart[1]
