"""What a healthy machine leaves, and what its constants may be, where no reference shows it."""

import mujoco
import numpy as np

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.constants import OWN, constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection.baseline import widened
from nerf2real.sysid.selection.evidence import Scored
from nerf2real.sysid.selection.remainder import usual_play
from nerf2real.sysid.selection.subject import own_library
from tests.sysid.synthetic import PENDULUM, log_of

MOTOR = PENDULUM.replace(
  '<position name="joint" joint="joint" kp="21"', '<motor name="joint" joint="joint"'
)


def left(xml, effects=()):
  """Returns what the declared model leaves in the median block, what play does, and the joint."""
  logs = [log_of(xml, "sweep", effects, duration=5.0)]
  joint = JointLikelihood(JointModel(mujoco.MjModel.from_xml_string(xml), "joint", logs))
  own = constants(joint.plant)
  fit = Fitter([joint], Layout([(own,)])).linearise(np.array(own.starts[0]))
  item = Scored((own,), fit, np.zeros(0))
  leaves = float(np.median(joint.squares(fit.residuals[0])[0]))
  return leaves, usual_play(joint, item, own_library(joint.plant, alone=True)), joint


def test_the_play_of_a_healthy_gear_is_left_anyway():
  leaves, usual, joint = left(PENDULUM, [Effect("backlash", "joint", OWN["backlash"])])
  anyway = joint.position_noise**2 + usual
  assert leaves > 4.0 * joint.position_noise**2
  assert leaves < 4.0 * anyway < 40.0 * leaves


def test_a_fault_leaves_more():
  friction = Effect("viscous_friction", "joint", {"coefficient": 0.3})
  leaves, usual, joint = left(PENDULUM, [friction])
  assert leaves > 4.0 * (joint.position_noise**2 + usual)


def test_a_direct_drive_has_no_play():
  assert left(MOTOR)[1] == 0.0


def test_all_torques_are_not_larger_by_a_factor_that_no_motion_shows():
  own = constants(left(PENDULUM)[2].plant)
  tight, freed = (dict(zip(own.names, t.prior, strict=True)) for t in (own, widened(own)))
  assert freed["gain"] == tight["gain"]
  assert freed["damping"] > 2.0 * tight["damping"]
