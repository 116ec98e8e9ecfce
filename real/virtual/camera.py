"""The virtual robot's camera: true pictures from its head through a lens and a sensor.

The pictures are those of the true room, never of the radiance field. The sensor has a response of
its own: white balance, gain and exposure act on the light, photons and the amplifier add noise.
"""

import dataclasses
from typing import Any, Protocol

import mujoco
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import pose_of_mujoco_camera
from nerf2real.real.clock import Clock
from nerf2real.real.virtual.body import Body
from nerf2real.scenes.builtin.mujoco_renderer import Eye

# The lens of the virtual robot's camera; chosen: as wide as a Logitech C920's, not quite without
# distortion, its axis not quite in the middle.
LENS = Camera(
  width=320,
  height=240,
  fx=303.5,
  fy=303.1,
  cx=161.6,
  cy=118.9,
  k1=0.045,
  k2=-0.07,
  p1=0.0004,
  p2=-0.0003,
)
_SUPERSAMPLE = 1  # 45 dB from 4 x 4 samples at 30x40, and half the time of 2 x 2
_HEAD_CAMERA = "op3/head_camera"
_GAMMA = 2.2
_SHOT_NOISE = 0.5  # share of the noise at mid grey that goes with the root of the light: chosen


@dataclasses.dataclass(frozen=True, kw_only=True)
class VirtualCamera:
  """The virtual robot's camera."""

  lens: Camera = LENS
  """What the pictures are rendered through."""
  rate: float = 30.0
  """Pictures a second."""
  latency: float = 0.04
  """s from the light to the arrival of a picture, as the driver has it."""
  undeclared_latency: float = 0.0
  """s more, of which the driver knows nothing: it takes pictures for younger than they are."""
  gain: float = 1.0
  """Factor on the signal; 1 is neutral."""
  exposure: float = 1.0
  """Factor on the light; 1 is neutral."""
  noise: float = 2.0
  """Standard deviation at mid grey and gain 1 [8-bit levels]."""
  white_balance: tuple[float, float, float] = (1.02, 1.0, 0.97)
  """Factors of this sensor on red, green and blue light; chosen."""

  def __post_init__(self) -> None:
    if not self.rate > 0:
      raise ValueError(f"The camera's rate must be positive [Hz], found {self.rate}.")
    if not (self.latency >= 0 and self.undeclared_latency >= 0):
      found = f"{self.latency} and {self.undeclared_latency}"
      raise ValueError(f"The camera's latencies must be 0 s or more, found {found}.")


class Sensor:
  """What the camera makes of a true picture."""

  def __init__(self, settings: VirtualCamera, *, seed: int | tuple[int, int] = 0):
    """Sets the sensor, with a seed for its noise."""
    self.gain, self.exposure, self.noise = settings.gain, settings.exposure, settings.noise
    self._balance = np.asarray(settings.white_balance)
    self._rng = np.random.default_rng(seed)

  def develop(self, picture: np.ndarray) -> np.ndarray:
    """Returns the picture uint8 [H, W, 3] that leaves the sensor.

    light = (v / 255)^2.2 * exposure * balance; noise of variance a + b light, times the gain;
    value = 255 * clip(gain * light + noise)^(1 / 2.2)
    """
    table = (np.arange(256) / 255.0) ** _GAMMA
    light = table[picture] * (self.exposure * self._balance)
    if self.noise > 0:
      middle = 0.5**_GAMMA
      # Levels to light at mid grey: d light / d value.
      deviation = self.noise / 255.0 * _GAMMA * 0.5 ** (_GAMMA - 1)
      share = _SHOT_NOISE * light / middle + (1 - _SHOT_NOISE)
      light = light + self._rng.normal(size=light.shape) * deviation * np.sqrt(share)
    signal = np.clip(self.gain * light, 0.0, 1.0) ** (1 / _GAMMA)
    return np.rint(255 * signal).astype(np.uint8)


class View(Protocol):
  """Pictures from a robot's head."""

  def picture(self, time: float | None = None) -> np.ndarray:
    """Returns the picture uint8 [H, W, 3] of now, or of a moment [s] up to 0.6 s ago."""

  def close(self) -> None:
    """Frees what the pictures are made with."""


def move_to(body: Body, data: mujoco.MjData, time: float | None) -> int:
  """Writes a body's kinematics of now, or of a moment [s], to data; returns its camera's id."""
  data.qpos[:] = body.pose_at(body.time if time is None else time)
  mujoco.mj_kinematics(body.model, data)
  mujoco.mj_camlight(body.model, data)
  return int(body.model.camera(_HEAD_CAMERA).id)


class Eyes:
  """True pictures from the robot's head. One thread uses it: an OpenGL context belongs to one."""

  def __init__(self, body: Body, lens: Camera):
    self._body, self._lens = body, lens
    self._eye: Any = None
    self._data: Any = None

  def picture(self, time: float | None = None) -> np.ndarray:
    """Returns the picture uint8 [H, W, 3] of now, or of a moment [s] up to 0.6 s ago."""
    model = self._body.model
    if self._eye is None or self._data is None:
      self._eye = Eye(model, groups=(0, 2))  # not the head, inside which the camera is
      self._data = mujoco.MjData(model)
    data = self._data
    camera = move_to(self._body, data, time)
    self._eye.update(data)
    pose = pose_of_mujoco_camera(data.cam_xpos[camera], data.cam_xmat[camera])
    return self._eye.render(self._lens, pose, supersample=_SUPERSAMPLE)[0]

  def close(self) -> None:
    """Frees the OpenGL context."""
    if self._eye is not None:
      self._eye.close()
      self._eye = None


class SteppedCamera:
  """The camera of a robot on a `SteppedClock`: the stream's sensor, without a network."""

  def __init__(
    self, eyes: View, clock: Clock, settings: VirtualCamera, *, seed: int | tuple[int, int]
  ):
    """Makes the camera; pictures are taken at multiples of the frame's duration."""
    self._eyes, self._clock, self._settings = eyes, clock, settings
    self.sensor = Sensor(settings, seed=seed)
    self._frame, self._picture = -1, np.zeros((1, 1, 3), np.uint8)
    self.frozen = False  # no new pictures come

  def read(self) -> tuple[np.ndarray, float]:
    """Returns the newest picture that has arrived, uint8 [H, W, 3], and its age as declared [s]."""
    settings, rate = self._settings, self._settings.rate
    seen = self._clock.now() - settings.undeclared_latency
    frame = int(np.floor((seen - settings.latency) * rate + 1e-6))
    if frame != self._frame and not (self.frozen and self._frame >= 0):
      self._frame = frame
      self._picture = self.sensor.develop(self._eyes.picture(frame / rate))
    return self._picture, seen - self._frame / rate

  def close(self) -> None:
    """Has nothing to free: the picture belongs to the robot."""
