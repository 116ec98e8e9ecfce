"""Which part of the gap between simulation and virtual robot does it: parts swapped one at a time.

PICTURE: in the simulation the true room with the robot's white balance, in place of the radiance
field's pictures; on the virtual robot the field's, without the sensor's noise. LENS: the other
one's. DELAY: the other one's camera rate and mean latency. PHYSICS: takes from the virtual robot
what is hidden in it, so that its servos, masses and sensors are those of the data sheets (its step,
contacts, drives and battery remain its own).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.real.virtual.body import Body
from nerf2real.real.virtual.camera import VirtualCamera, move_to
from nerf2real.scenes.builtin import room
from nerf2real.suite import loading
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.sensors.camera import CameraSettings, RobotCamera

PICTURE, LENS, DELAY, PHYSICS = "picture", "lens", "delay", "physics"
_OF_THE_CAMERA = (PICTURE, LENS, DELAY)
_KNOWN = {"sim": _OF_THE_CAMERA, "virtual": (*_OF_THE_CAMERA, PHYSICS)}
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


class FieldView:
  """The simulation's pictures from a virtual robot's head: the radiance field and the robot."""

  def __init__(self, body: Body, camera: RobotCamera):
    """Binds the simulation's camera to the body's model."""
    self._body, self._camera, self._data = body, camera, mujoco.MjData(body.model)
    camera.bind(body.model, move_to(body, self._data, None))

  def picture(self, time: float | None = None) -> np.ndarray:
    """Returns the picture uint8 [H, W, 3] of now, or of a moment [s] up to 0.6 s ago."""
    move_to(self._body, self._data, time)
    return self._camera.render(self._data)

  def close(self) -> None:
    """Has nothing to free."""


def field_view(
  scene: Any, image_size: tuple[int, int], lens: Camera
) -> Callable[[Body], FieldView]:
  """Returns what makes the simulation's pictures of a body.

  Args:
    scene: The bundle with the field.
    image_size: Height and width of the policy's picture.
    lens: Through which they are rendered.
  """
  neutral = CameraSettings(lens=lens)
  camera = RobotCamera(
    loading.load_renderer(scene),
    neutral.camera(image_size),
    world_from_unit=scene.world_from_unit,
    settings=neutral,
  )
  return lambda body: FieldView(body, camera)


def camera_in_simulation(camera: CameraSettings, parts: Sequence[str]) -> CameraSettings:
  """Returns a simulated camera with the virtual one's parts; the noise of a pixel averages out."""
  virtual = VirtualCamera()
  if PICTURE in parts:
    camera = dataclasses.replace(camera, white_balance=virtual.white_balance)
  if LENS in parts:
    camera = dataclasses.replace(camera, lens=virtual.lens)
  if DELAY in parts:
    latency = max(0.0, virtual.latency - _mean_delay())
    camera = dataclasses.replace(camera, rate=virtual.rate, latency=latency)
  return camera


def camera_on_the_robot(
  camera: VirtualCamera, simulated: CameraSettings, parts: Sequence[str]
) -> VirtualCamera:
  """Returns a virtual robot's camera with a simulated one's parts."""
  if PICTURE in parts:
    camera = dataclasses.replace(camera, noise=0.0, white_balance=(1.0, 1.0, 1.0))
  if LENS in parts:
    lens = simulated.camera((camera.lens.height, camera.lens.width))
    camera = dataclasses.replace(camera, lens=lens)
  if DELAY in parts:
    latency = simulated.latency + _mean_delay()
    camera = dataclasses.replace(camera, rate=simulated.rate, latency=latency)
  return camera


def _mean_delay() -> float:
  """Returns what the simulation's episodes draw as the camera's delay, in the mean [s]."""
  return float(np.mean(RandomisationSettings().delay_range))


def check(parts: Sequence[str], *, plant: str, built_in: bool) -> None:
  """Raises ValueError where a part cannot be swapped.

  Args:
    parts: Of PICTURE, LENS, DELAY, PHYSICS.
    plant: "sim", "virtual", "both" or "robot".
    built_in: Whether the scene is that of the built-in room.
  """
  for part in parts:
    if part not in _KNOWN.get(plant, ()):
      able = " or ".join(f"--plant {name}" for name, known in _KNOWN.items() if part in known)
      raise ValueError(f"--swap {part} with --plant {plant}: expected {able}.")
  if PICTURE in parts and not built_in:
    raise ValueError(
      "--swap picture knows the true pictures of the built-in room alone: leave --scene out."
    )
