"""The actuators of a model's joints, and the commands of a log as they act on them.

Shapes: T steps of a simulation, U actuators of the model.
"""

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.core.robot_logs.series import JointSeries

Array = np.ndarray


def holds_position(model: mujoco.MjModel, actuator: int) -> bool:
  """Tells whether an actuator has a position loop, so that errors do not accumulate."""
  return float(model.actuator_biasprm[actuator, 1]) < 0.0


def joint_of(model: mujoco.MjModel, actuator: int) -> str | None:
  """Returns the joint that an actuator drives; None of one that pulls a tendon, site or body."""
  if int(model.actuator_trntype[actuator]) != int(mujoco.mjtTrn.mjTRN_JOINT):
    return None
  return str(model.joint(int(model.actuator_trnid[actuator, 0])).name)


def actuators_of(model: mujoco.MjModel, joint: str) -> list[int]:
  """Returns all actuators on a joint."""
  on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
  found = np.flatnonzero(on_joint & (model.actuator_trnid[:, 0] == model.joint(joint).id))
  return [int(u) for u in found]


def actuator_of(model: mujoco.MjModel, joint: str) -> int:
  """Returns the actuator that drives a joint, -1 if none does."""
  return next(iter(actuators_of(model, joint)), -1)


def pulling(model: mujoco.MjModel, joint: str) -> list[str]:
  """Returns the names of the actuators on tendons that a joint is tied to."""
  tied = (model.wrap_type == int(mujoco.mjtWrap.mjWRAP_JOINT)) & (
    model.wrap_objid == model.joint(joint).id
  )
  tendons = np.searchsorted(model.tendon_adr, np.flatnonzero(tied), side="right") - 1
  on_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
  found = np.flatnonzero(on_tendon & np.isin(model.actuator_trnid[:, 0], tendons))
  return [model.actuator(int(u)).name or f"number {u}" for u in found]


def takes(model: mujoco.MjModel, actuator: int) -> str:
  """Returns what an actuator is told, as a field of commands: position, velocity or effort."""
  if holds_position(model, actuator):
    return "position"
  speed_gain = -float(model.actuator_biasprm[actuator, 2])
  is_velocity_servo = speed_gain > 0.0 and speed_gain == float(model.actuator_gainprm[actuator, 0])
  return "velocity" if is_velocity_servo else "effort"


def command_of(log: Log, model: mujoco.MjModel, joint: str) -> Array | None:
  """Returns a joint's commands [N] in what its actuator takes, within what it takes of that; None
  where a log lacks those."""
  return _command_in(log.commands, model, joint)


def _command_in(commands: JointSeries, model: mujoco.MjModel, joint: str) -> Array | None:
  u = actuator_of(model, joint)
  values = getattr(commands, takes(model, u))
  if values is None:
    return None
  column: Array = values[:, commands.column(joint)]
  if np.isnan(column).all():  # it is told another quantity
    return None
  return np.clip(column, *model.actuator_ctrlrange[u]) if model.actuator_ctrllimited[u] else column


class Told:
  """A log's commands as the actuators of a model take them: of the model as it is when this is
  made, as effects that are bound to it write into its actuators while it is simulated.

  Those of joints that are not judged move them, too. A joint that is measured and not commanded is
  held at its first reading where its actuator holds a position: it was not told to go to 0.
  """

  def __init__(self, model: mujoco.MjModel, log: Log):
    """Reads the commands.

    Args:
      model: compiled model.
      log: its commands.
    """
    self._stamp = log.commands.stamp
    spans = np.diff(self._stamp, append=self._stamp[-1])
    self._still = np.zeros(model.nu)
    both = [series for series in (log.commands, log.aside) if series is not None]
    told = {name: series for series in both for name in series.joints}
    for name in set(log.joints) - set(told):
      for u in actuators_of(model, name):
        self._still[u] = _holding(model, log, name, u)
    self._commands: dict[int, tuple[Array, Array]] = {}
    for name, series in told.items():
      command = _command_in(series, model, name)
      if command is None:  # only of joints that are not judged
        continue
      total = np.concatenate([[0.0], np.cumsum(command * spans)[:-1]])
      self._commands[actuator_of(model, name)] = command, total

  def mean(self, times: Array, step: float, late_by: Array | None = None) -> Array:
    """Returns the mean command [T, U] of every step, each held until the next comes, and late.

    A command that comes within a step acts for the rest of it: used from the next step on it would
    be half a step late in the mean, which a moving joint shows.

    Args:
      times: at which the steps begin [T], s.
      step: s.
      late_by: of every actuator [U], s; none is if left out.
    """
    result = np.tile(self._still, (len(times), 1))
    for u, (command, total) in self._commands.items():
      begin = times - (0.0 if late_by is None else late_by[u])
      edges = []
      for at in (begin, begin + step):
        index = np.clip(np.searchsorted(self._stamp, at, side="right") - 1, 0, len(self._stamp) - 1)
        edges.append(total[index] + command[index] * (at - self._stamp[index]))
      result[:, u] = (edges[1] - edges[0]) / step
    return result


def _holding(model: mujoco.MjModel, log: Log, joint: str, actuator: int) -> float:
  """Returns the command at which a position servo's torque is zero at a joint's first reading; 0
  of an actuator that holds no position."""
  if not holds_position(model, actuator):
    return 0.0
  assert log.states.position is not None
  first = float(log.states.position[0, log.states.column(joint)])
  gear, gain = float(model.actuator_gear[actuator, 0]), float(model.actuator_gainprm[actuator, 0])
  constant, per_position = model.actuator_biasprm[actuator, :2]
  return -float(constant + per_position * gear * first) / gain
