"""What the sensors beside the joints say: IMU, camera and floor, in one finding."""

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np

from nerf2real.core.geometry.rotations import matrix_from_rotvec
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.sensors import brightness, floor, inertial, optical
from nerf2real.sysid.sensors.sensed import Part


@dataclasses.dataclass(frozen=True)
class Sensed:
  """What all sensors say."""

  parts: dict[str, Part]
  """By "imu", "camera", "brightness", "floor"; those that logs and model have."""

  @property
  def whole(self) -> Part:
    """What all of them name and say together."""
    every = self.parts.values()
    joined = {
      name: [entry for part in every for entry in getattr(part, name)]
      for name in ("rows", "alternatives", "notes", "in_reference")
    }
    return Part(**joined)  # type: ignore[arg-type]

  def errors(self) -> dict[str, dict[str, float]]:
    """Returns each sensor's error without and with its effects, in its own measure.

    RMS over the noise of the IMU, pixels of the camera, the logarithm of brightness, radians.
    """
    return {
      name: {"before": round(part.before, 4), "after": round(part.after, 4)}
      for name, part in self.parts.items()
      if part.before is not None and part.after is not None
    }


def find(
  model: mujoco.MjModel,
  logs: Sequence[Log],
  reference: Sequence[Log] = (),
  *,
  tilt: Mapping[str, float] | None = None,
) -> Sensed:
  """Returns what the sensors show beyond the model's.

  Args:
    model: the declared one.
    logs: to identify from; what they hold from before their first commands counts, too.
    reference: of the same apparatus at the same place; what sensors show there, too, is no change.
    tilt: turn of gravity about x and y in the logs, as the joints show it [rad].
  """
  logs, reference = [log.whole for log in logs], [log.whole for log in reference]
  parts: dict[str, Part] = {}
  imu = inertial.find(_leaning(model, tilt) if tilt else model, logs)
  if imu is not None:
    parts["imu"] = _compared(imu, lambda: inertial.find(model, reference), reference)
  seen = optical.find(model, logs)
  if seen is not None:
    before = lambda: getattr(optical.find(model, reference), "part", None)  # noqa: E731
    parts["camera"] = _compared(seen.part, before, reference)
    parts["brightness"] = brightness.find(model, seen, reference)
  stood = floor.find(model, logs)
  if stood is not None:
    parts["floor"] = _compared(stood, lambda: floor.find(model, reference), reference)
  return Sensed(parts)


def _compared(part: Part, before: Callable[[], Part | None], reference: Sequence[Log]) -> Part:
  """Returns what a sensor shows beside what it showed in the reference, if there is one."""
  known = before() if part.rows and reference else None
  return part if known is None else part.beside(known)


def _leaning(model: mujoco.MjModel, tilt: Mapping[str, float]) -> mujoco.MjModel:
  """Returns a model with gravity turned."""
  result = copy.copy(model)
  turn = matrix_from_rotvec([tilt["x"], tilt["y"], 0.0])
  result.opt.gravity[:] = turn @ np.array(model.opt.gravity)
  return result
