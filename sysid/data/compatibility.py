"""Checks that a model has the joints and actuators that a measured log speaks of."""

import mujoco
import numpy as np

from nerf2real.core.robot_logs.messages import COMMANDS, STATES
from nerf2real.core.robot_logs.reading import Log
from nerf2real.core.robot_logs.streaming import LogError
from nerf2real.sysid.data.plausibility import check_units
from nerf2real.sysid.model import chains
from nerf2real.sysid.model.drive import (
  actuator_of,
  actuators_of,
  command_of,
  holds_position,
  pulling,
  takes,
)

_PLURAL = {"position": "positions", "velocity": "velocities", "effort": "efforts"}
_NEAR = 0.005  # of a joint's range from its end that counts as there; chosen
_OFTEN = 0.01  # of the readings that may be held there; chosen


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
  for name in log.commands.joints:
    kind = int(model.joint(name).type[0])
    if kind not in chains.SINGLE:
      raise LogError(f"{log.name} commands {name!r}, in the model neither a hinge nor a slide.")
    actuators = actuators_of(model, name)
    pulled = [] if actuators else pulling(model, name)
    if pulled:
      raise LogError(
        f"{log.name} commands {name!r}, which the model drives by a tendon alone ({pulled}), "
        "expected an actuator on the joint: leave its commands out, it is then measured and not "
        "judged."
      )
    if not actuators:
      driven = sorted(joint for joint in filter(None, names) if actuators_of(model, joint))
      raise LogError(
        f"{log.name} commands {name!r}, but no actuator of the model drives that joint: it drives "
        f"{driven}."
      )
    if len(actuators) > 1:
      several = [model.actuator(u).name or f"number {u}" for u in actuators]
      raise LogError(
        f"{log.name} commands {name!r}, which the actuators {several} of the model drive, expected "
        "one: keep the one that is commanded."
      )
    if command_of(log, model, name) is None:
      quantity = takes(model, actuator_of(model, name))
      wanted = _PLURAL[quantity]
      lacks = f"{wanted} in {COMMANDS}"
      if log.path is not None and log.path.suffix.lower() == ".csv":
        lacks = f"column command_{quantity}:{name}"
      raise LogError(
        f"{log.name} has no {lacks}, which the model's actuator on {name!r} takes: "
        f"record {wanted}, or give a model with the actuator that was driven."
      )
    check_units(log, model, name)
    _check_range(log, model, name)


def _check_range(log: Log, model: mujoco.MjModel, name: str) -> None:
  """Raises a LogError where a joint is commanded past its declared range and stops at the end."""
  index, wanted = model.joint(name).id, command_of(log, model, name)
  holds = holds_position(model, actuator_of(model, name))
  if not model.jnt_limited[index] or not holds or wanted is None:
    return
  assert log.states.position is not None
  low, high = model.jnt_range[index]
  at, near = log.states.position[:, log.states.column(name)], _NEAR * (high - low)
  command = np.interp(log.states.stamp, log.commands.stamp, wanted)
  pushed = (at > high - near) & (command > high + near)
  pushed |= (at < low + near) & (command < low - near)
  if np.mean(pushed) > _OFTEN:
    raise LogError(
      f"{log.name} commands {name!r} past the end of its declared range, {low:.3g} to {high:.3g} "
      f"rad or m, where it stops in {np.mean(pushed):.0%} of the readings; end stops are not "
      "simulated: record within the range, or correct the model's (in degrees, unless its compiler "
      "says radian)."
    )
