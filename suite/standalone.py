"""The OP3 as a MuJoCo specification of its own, standing, for models made without composer."""

import mujoco

from nerf2real.scenes.export.mjcf import StandingRobot
from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.tasks.state import standing_posture


def standing_robot() -> StandingRobot:
  """Returns the robot and the posture in which it stands at rest."""
  root = op3.OP3().mjcf_model
  posture = standing_posture()
  return StandingRobot(
    spec=mujoco.MjSpec.from_string(root.to_xml_string()),
    root=constants.TORSO_LINK,
    pose=posture[:7],
    angles=dict(zip(constants.JOINT_NAMES, posture[7:].tolist(), strict=True)),
    controls=constants.standing_targets(),
  )
