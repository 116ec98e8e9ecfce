"""Constants that are off where no reference shows them."""

import mujoco

from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection.joints.baseline import widened
from tests.sysid.synthetic import PENDULUM, log_of


def test_all_torques_are_not_larger_by_a_factor_that_no_motion_shows():
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  own = constants(JointModel(model, "joint", [log_of(PENDULUM, "sweep", duration=5.0)]))
  tight, freed = (dict(zip(own.names, t.prior, strict=True)) for t in (own, widened(own)))
  assert freed["gain"] == tight["gain"]
  assert freed["damping"] > 2.0 * tight["damping"]
