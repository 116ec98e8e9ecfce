"""Which part of the gap between simulation and virtual robot does it: one part swapped at a time.

PICTURE puts the true room's pictures into the simulation, in place of the radiance field's; DELAY
puts the virtual camera's rate and latency into it; PHYSICS takes from the virtual robot what is
hidden in it, so that its servos, masses and sensors are those of the data sheets (its step,
contacts and battery remain its own).
"""

import dataclasses
from typing import Any

import numpy as np

from nerf2real.core.cameras import Camera
from nerf2real.real.virtual.camera import VirtualCamera
from nerf2real.scenes.builtin import room
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.sensors.camera import CameraSettings

NONE, PICTURE, DELAY, PHYSICS = "none", "picture", "delay", "physics"
IN_SIMULATION, ON_THE_ROBOT = (PICTURE, DELAY), (PHYSICS,)
_SAMPLES = 8  # of a pixel along each side: as many as the robot's 320x240 give at 30x40


class TrueRoom:
  """Renders the built-in room itself, as a radiance field of it is rendered."""

  def __init__(self, scene: Any):
    """Opens the room.

    Args:
      scene: The bundle of the built-in room, for its frame.
    """
    self._world_from_unit = scene.world_from_unit
    self._eye = room.room_eye()

  def render(self, camera: Camera, unit_from_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns colour uint8 [H, W, 3] and z-depth float32 [H, W] in the field's unit."""
    pose = self._world_from_unit.apply_pose(unit_from_camera)
    color, depth = self._eye.render(camera, pose, supersample=_SAMPLES)
    return color, (depth / self._world_from_unit.scale).astype(np.float32)

  def close(self) -> None:
    """Frees the OpenGL context."""
    self._eye.close()


def camera_of_the_robot(camera: CameraSettings | None) -> CameraSettings:
  """Returns a simulated camera with the virtual one's rate and, on average, its latency.

  Args:
    camera: The simulation's; None: the neutral one.
  """
  virtual = VirtualCamera()
  delay = float(np.mean(RandomisationSettings().delay_range))
  return dataclasses.replace(
    camera or CameraSettings(), rate=virtual.rate, latency=max(0.0, virtual.latency - delay)
  )


def check(swap: str, *, plant: str, built_in: bool) -> None:
  """Raises ValueError where a part cannot be swapped.

  Args:
    swap: One of NONE, PICTURE, DELAY, PHYSICS.
    plant: "sim", "virtual", "both" or "robot".
    built_in: Whether the scene is that of the built-in room.
  """
  known = {"sim": IN_SIMULATION, "virtual": ON_THE_ROBOT}.get(plant, ())
  if swap != NONE and swap not in known:
    raise ValueError(
      f"--swap {swap} with --plant {plant}: expected --plant sim for {' or '.join(IN_SIMULATION)}, "
      f"--plant virtual for {' or '.join(ON_THE_ROBOT)}."
    )
  if swap == PICTURE and not built_in:
    raise ValueError(
      "--swap picture knows the true pictures of the built-in room alone: leave --scene out."
    )
