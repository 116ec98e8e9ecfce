"""What a mass on a body adds to the joints that carry it, against a model that has the mass."""

import mujoco
import numpy as np
import pytest

from nerf2real.suite.randomisation import inertia as masses
from nerf2real.sysid.model.reduction import Reduction
from tests.sysid.synthetic import ARM, PENDULUM, log_of

_SLIDING = """
<mujoco><option timestep="0.001" integrator="implicitfast"/>
  <worldbody><body name="cart">
    <joint name="rail" type="slide" axis="1 0 0.3"/>
    <inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
    <body name="arm" pos="0 0 0.1">
      <joint name="swing" axis="0 1 0.2"/>
      <inertial pos="0.1 0 0" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>
    </body>
  </body></worldbody>
  <actuator>
    <position name="rail" joint="rail" kp="300" kv="30"/>
    <position name="swing" joint="swing" kp="21" kv="1"/>
  </actuator>
</mujoco>"""


@pytest.mark.parametrize(("xml", "body"), [(ARM, "lower"), (ARM, "upper"), (_SLIDING, "arm")])
def test_a_mass_adds_what_a_model_that_has_it_feels(xml, body):
  model = mujoco.MjModel.from_xml_string(xml)
  log = log_of(xml, "sweep", duration=2.0)
  mass, place = 0.35, np.array([0.03, -0.05, -0.12])
  x, y, z = place
  factors = mass * np.array([1, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])
  index = model.body(body).id
  for joint in log.joints:
    reduction = Reduction(model, log)
    before = reduction.of_joint(joint)
    parts = reduction.moments(joint, index)
    snapshot = masses.Snapshot(model)
    masses.attach_mass(model, index, added=mass, position=place)
    masses.refresh(model, mujoco.MjData(model), snapshot)
    after = Reduction(model, log, motion=reduction.detailed).of_joint(joint)
    snapshot.restore(model)
    for field in ("inertia", "here", "across", "bias"):
      gained = sum(f * getattr(p, field) for f, p in zip(factors, parts, strict=True))
      expected = getattr(after, field) - getattr(before, field)
      np.testing.assert_allclose(gained, expected, atol=1e-9)


def test_a_single_joint_s_mass_does_not_depend_on_the_motion():
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  parts = Reduction(model, log_of(PENDULUM, "sweep", duration=2.0)).moments("joint", 1)
  assert all(np.ptp(p.here) == 0 and np.all(p.bias == 0) for p in parts)
  assert parts[0].across[0] == 0 and parts[3].across[0] == pytest.approx(-9.81)
