"""What duty a servo's law makes of commands and readings.

The readings feed the law, so that no motion is simulated. Shapes: N samples of a log or of all, P
kernel parameters (`kernel.NAMES`).
"""

import numpy as np

from nerf2real.sysid.model.kernel import INDEX, NAMES
from nerf2real.sysid.model.measured import Measured
from nerf2real.sysid.model.plant import JointPlant

Array = np.ndarray

ASKED = [
  *(INDEX[name] for name in ("command_delay", "measurement_delay", "effort_delay", "clock_rate")),
  *(INDEX[name] for name in ("input", "constant", "position", "velocity")),
]
"""Kernel parameters by which the torque is that a law asks for."""

_KEPT = 4  # torques: of a fit's place, of differences to it, further ahead


def duty_of(plant: JointPlant, p: Array, index: int, *, ahead: float = 0.0) -> Array:
  """Returns the duty [N] that a servo's law makes of a log's commands and readings.

  Supply and heat change the torque at a duty, not the duty.

  Args:
    plant: the joint.
    p: kernel parameters [P].
    index: of the log.
    ahead: s by which the positions that the duty is of are later than those read with it.
  """
  return duty_for(plant, p, asked_torque(plant, p, index, ahead=ahead))


def asked_torque(plant: JointPlant, p: Array, index: int, *, ahead: float = 0.0) -> Array:
  """Returns the torque [N] that a law of gain 1 asks for, without limits: `duty_of`'s arguments. Of
  the parameters `ASKED` alone matter."""
  value = dict(zip(NAMES, p, strict=True))
  log, rate = plant.logs[index], 1.0 + value["clock_rate"]
  true = log.time / rate - value["effort_delay"]
  command = _held(log, true - value["command_delay"])
  stamp = (true + value["measurement_delay"] + ahead) * rate
  read, speed = (np.interp(stamp, log.time, row) for row in (log.position, log.velocity))
  torque = value["input"] * command + value["constant"]
  return torque + value["position"] * read + value["velocity"] * speed


class Asked:
  """What `asked_torque` returns for all logs of a joint; the last few are kept: of the differences
  that a fit takes most leave it as it is."""

  def __init__(self, plant: JointPlant):
    self._plant = plant
    self._kept: dict[tuple[bytes, float], Array] = {}

  def torque(self, p: Array, ahead: float) -> Array:
    """Returns the torque [N] of kernel parameters [P]; `ahead` as of `duty_of`."""
    key, logs = (p[ASKED].tobytes(), ahead), range(len(self._plant.logs))
    torque = self._kept.pop(key, None)
    if torque is None:
      torque = np.concatenate([asked_torque(self._plant, p, i, ahead=ahead) for i in logs])
    self._kept[key] = torque
    if len(self._kept) > _KEPT:
      self._kept.pop(next(iter(self._kept)))
    return torque


def duty_for(plant: JointPlant, p: Array, torque: Array) -> Array:
  """Returns the duty [N] of kernel parameters [P] for a torque [N] asked for by `asked_torque`."""
  value = dict(zip(NAMES, p, strict=True))
  limited = np.clip(value["gain"] * torque, value["lowest"], value["highest"])
  return limited / (value["strength"] * plant.declared[INDEX["highest"]])


def command_jump(plant: JointPlant, index: int, within: float, *, delay: float = 0.0) -> Array:
  """Returns by how much of full duty [N] commands jump within so many seconds of a sample, heard
  after a delay."""
  log = plant.logs[index]
  heard = log.time - delay
  slope = plant.declared[INDEX["input"]] / plant.declared[INDEX["highest"]]
  return np.abs(slope * (_held(log, heard + within) - _held(log, heard - within)))


def _held(log: Measured, time: Array) -> Array:
  """Returns the last command [N] at each time [N]."""
  at = np.searchsorted(log.command_time, time, side="right") - 1
  return log.command[np.clip(at, 0, None)]
