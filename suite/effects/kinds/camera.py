"""What differs between the rendered picture and the camera's: channel "camera", uint8 [H, W, C]."""

import math

import cv2
import numpy as np

from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Array, Kind, Operator, Parameter
from nerf2real.suite.sensors.delays import DelayLine


class CameraGain(Operator):
  """The picture is `gain` times as bright, clipped."""

  def bind(self, binding: Binding) -> None:
    self._gain = math.prod(self.value(effect, "gain") for effect in self.effects)

  def observe(self, channel: str, value: Array, time: float) -> Array:
    if channel != "camera" or self._gain == 1:
      return value
    return np.clip(np.rint(value * self._gain), 0, 255).astype(np.uint8)


class CameraLatency(Operator):
  """The picture is `delay` seconds old: the newest one that has arrived."""

  def bind(self, binding: Binding) -> None:
    self._delay = sum(self.value(effect, "delay") for effect in self.effects)
    self._line = DelayLine(self._delay, capacity=256)

  def reset(self) -> None:
    self._line.reset(self._delay)

  def observe(self, channel: str, value: Array, time: float) -> Array:
    if channel != "camera" or self._delay == 0:
      return value
    self._line.push(time, value)
    return self._line.read(time)


class CameraFocal(Operator):
  """The focal length is `scale` times the declared one: the picture is magnified about its centre.

  For given pictures, resampled bilinearly; where a smaller focal length would see more, the border
  is repeated. The suite's tasks render through the other lens instead.
  """

  def bind(self, binding: Binding) -> None:
    self._scale = math.prod(self.value(effect, "scale") for effect in self.effects)

  def observe(self, channel: str, value: Array, time: float) -> Array:
    if channel != "camera" or self._scale == 1:
      return value
    height, width = value.shape[:2]
    s = self._scale
    centre_x, centre_y = (width - 1) / 2, (height - 1) / 2
    matrix = np.array([[s, 0.0, (1 - s) * centre_x], [0.0, s, (1 - s) * centre_y]])
    return cv2.warpAffine(
      np.ascontiguousarray(value),
      matrix,
      (width, height),
      flags=cv2.INTER_LINEAR,
      borderMode=cv2.BORDER_REPLICATE,
    ).reshape(value.shape)


KINDS = (
  Kind(
    "camera_focal",
    "the focal length is off",
    "none",
    "measurement",
    (Parameter("scale", "1", 1.0, 0.8, 1.25, "true over declared focal length", minimum=0.05),),
    CameraFocal,
  ),
  Kind(
    "camera_gain",
    "the picture is brighter or darker",
    "none",
    "measurement",
    (Parameter("gain", "1", 1.0, 0.02, 2.56, "true over nominal brightness", minimum=0.0),),
    CameraGain,
  ),
  Kind(
    "camera_latency",
    "the picture is old",
    "none",
    "measurement",
    (Parameter("delay", "s", 0.0, 0.0, 0.15, "latency", minimum=0.0, maximum=2.0),),
    CameraLatency,
  ),
)
