"""Checks that a model has the joints and actuators that a measured log speaks of."""

import mujoco

from nerf2real.core.robot_logs.messages import COMMANDS, STATES
from nerf2real.core.robot_logs.reading import Log
from nerf2real.core.robot_logs.streaming import LogError


def check_against_model(log: Log, model: mujoco.MjModel) -> None:
  """Raises a LogError where a model has not the joints and actuators that a log speaks of."""
  names = [model.joint(index).name for index in range(model.njnt)]
  missing = [name for name in dict.fromkeys(log.commands.joints + log.joints) if name not in names]
  if missing:
    raise LogError(
      f"{log.name} has the joints {missing} that the model lacks: it has {names}; give the model "
      "of this apparatus, or the log's joints the model's names."
    )
  unmeasured = [name for name in log.commands.joints if name not in log.joints]
  if unmeasured:
    raise LogError(
      f"{log.name} commands {unmeasured} but {STATES} has no such joints: record their positions."
    )
  joint_transmission = int(mujoco.mjtTrn.mjTRN_JOINT)
  driven = {
    names[model.actuator_trnid[index, 0]]: index
    for index in range(model.nu)
    if model.actuator_trntype[index] == joint_transmission
  }
  for name in log.commands.joints:
    kind = int(model.joint(name).type[0])
    if kind not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
      raise LogError(f"{log.name} commands {name!r}, in the model neither a hinge nor a slide.")
    if name not in driven:
      raise LogError(
        f"{log.name} commands {name!r}, but no actuator of the model drives that joint: it drives "
        f"{sorted(driven)}."
      )
    takes = "position" if model.actuator_biasprm[driven[name], 1] != 0.0 else "effort"
    if getattr(log.commands, takes) is None:
      raise LogError(
        f"{log.name} has no {takes}s in {COMMANDS}, which the model's actuator on {name!r} takes: "
        f"record {takes}s, or give a model with the actuator that was driven."
      )
