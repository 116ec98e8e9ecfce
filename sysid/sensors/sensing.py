"""What the sensors beside the joints say: IMU, camera and floor, in one finding."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco

from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect
from nerf2real.sysid.sensors import brightness, floor, inertial, optical
from nerf2real.sysid.sensors.sensed import Part


@dataclasses.dataclass(frozen=True)
class Sensed:
  """What all sensors say."""

  parts: dict[str, Part]
  """By "imu", "camera", "brightness", "floor"; those that logs and model have."""

  @property
  def rows(self) -> list[dict[str, Any]]:
    """Entries of the report for what is named."""
    return [row for part in self.parts.values() for row in part.rows]

  @property
  def effects(self) -> list[Effect]:
    """The same as effects that can be simulated."""
    return [effect for part in self.parts.values() for effect in part.effects]

  @property
  def alternatives(self) -> list[dict[str, Any]]:
    """Entries for what cannot be told apart."""
    return [row for part in self.parts.values() for row in part.alternatives]

  @property
  def notes(self) -> list[str]:
    """What was not looked at, and why, a line each."""
    return list(dict.fromkeys(note for part in self.parts.values() for note in part.notes))

  def errors(self) -> dict[str, dict[str, float]]:
    """Returns each sensor's error without and with its effects, in its own measure.

    RMS over the noise of the IMU, pixels of the camera, the logarithm of brightness, radians.
    """
    return {
      name: {"before": round(part.before, 4), "after": round(part.after, 4)}
      for name, part in self.parts.items()
      if part.before is not None and part.after is not None
    }


def find(model: mujoco.MjModel, logs: Sequence[Log], reference: Sequence[Log] = ()) -> Sensed:
  """Returns what the sensors show beyond the model's.

  Args:
    model: the declared one.
    logs: to identify from.
    reference: of the same apparatus at the same place; what brightness is compared with.
  """
  parts: dict[str, Part] = {}
  imu = inertial.find(model, logs)
  if imu is not None:
    parts["imu"] = Part(imu.rows, imu.alternatives, [], imu.before, imu.after)
  seen = optical.find(model, logs)
  if seen is not None:
    parts["camera"] = seen.part
    parts["brightness"] = brightness.find(model, seen, reference)
  stood = floor.find(model, logs)
  if stood is not None:
    parts["floor"] = stood
  return Sensed(parts)
