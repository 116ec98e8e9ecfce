"""Renders a trained field: one ray a pixel through the camera's own lens, colour and depth."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.field import occupancy as occupancy_lib
from nerf2real.scenes.field.engine.device import Device
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render import kernels as render_kernels
from nerf2real.scenes.field.render import weights as render_weights

VERSION = 2  # of what is drawn of a field; 2: thin things that stand by themselves, too
_MAX_GROWTH_DISTANCE = 2.0  # [unit] steps double at latest from twice here on: behind the unit cube


@dataclasses.dataclass(frozen=True, kw_only=True)
class RenderSettings:
  """Settings of the march along rays."""

  step: float = 0.008
  """Finest interval between samples [unit]; 2 cm in a room of 5 m. From pictures of the
  built-in room: 0.006 gains 0.2 dB and takes a tenth longer, 0.016 loses 1.3 dB or more."""
  steps_per_footprint: float = 1.4
  """Intervals in the width of a pixel's footprint, at least. Chosen: above 1, below which surfaces
  can fall between samples."""
  near: float = 0.02
  """Distance [unit] from the camera at which a ray starts. Chosen: 5 cm in a room of 5 m, nearer
  than a capture comes to anything."""
  far: float = 32.0
  """Distance [unit] at which a ray ends. Chosen: 31/32 of the squashed space is used up."""
  stop: float = 0.05
  """Transmittance at which a ray ends; what is left is shared out among its samples. Chosen:
  0.02 gains 0.05 dB and takes a third longer where surfaces are soft."""
  weight_floor: float = 0.01
  """Samples of less weight get no colour of their own. Chosen: 1 % of a colour is 2 of 255."""

  specular_per_sample: bool = True
  """Evaluate the view network for every sample; if not, once a ray with the mean bottleneck: a
  tenth faster, 0.2 to 0.4 dB worse."""

  def __post_init__(self):
    if not (self.step > 0 and self.steps_per_footprint > 0 and 0 <= self.near < self.far):
      raise ValueError(f"Found {self}; expected positive steps and 0 <= near < far.")
    if not (0 <= self.stop < render_kernels.MEDIAN and 0 <= self.weight_floor < 1):
      raise ValueError(
        f"Found stop={self.stop}, weight_floor={self.weight_floor}; expected 0 <= stop < "
        f"{render_kernels.MEDIAN} and 0 <= weight_floor < 1."
      )

  def growth_steps(self, pixel_angle: float) -> int:
    """Intervals of a level before they double, see `scenes.field.render.kernels`."""
    footprint = math.ceil(self.steps_per_footprint / pixel_angle)
    return max(1, min(footprint, math.ceil(_MAX_GROWTH_DISTANCE / self.step)))


class Renderer:
  """A field on a device, ready to render; calls from several threads are independent.

  On a CPU a call uses one core and releases the interpreter, so that threads render in parallel.
  """

  def __init__(
    self,
    field: Field,
    *,
    settings: RenderSettings | None = None,
    occupancy: occupancy_lib.Occupancy | None = None,
    device: str = "cpu",
    threads: int = 1,
  ):
    """Uploads the field.

    Args:
      field: A trained field.
      settings: How to march.
      occupancy: Where the field holds matter; found here if None.
      device: "cpu", "cuda" or another of Warp's names.
      threads: Threads that share the rays of a call on a CPU.

    Raises:
      ValueError: If there is no such device.
    """
    self.field = field
    self.settings = settings or RenderSettings()
    self._device = Device(device, threads=threads if device == "cpu" else 1)
    if occupancy is None:
      occupancy = occupancy_lib.build(field, device=self._device)
    self.occupancy = occupancy
    packed = render_weights.pack(field.settings, field.params)
    self._kernels = render_kernels.build(packed.layout)
    self._data = render_kernels.upload(packed, field.settings.march_step, self._device)
    self._distance: Any = self._device.put(occupancy.distance.ravel())
    self._camera_rays = functools.lru_cache(maxsize=16)(self._upload_rays)
    self._march = functools.lru_cache(maxsize=16)(self._march_data)

  def render(self, camera: Camera, unit_from_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renders one picture.

    Args:
      camera: The camera.
      unit_from_camera: Its pose [4, 4] in the unit frame, OpenCV axes.

    Returns:
      Colour uint8 [H, W, 3] and z-depth float32 [H, W] in units of the unit frame; inf where less
      than half of a ray's light comes from matter.
    """
    color, depth = self.render_batch(camera, np.asarray(unit_from_camera)[None])
    return color[0], depth[0]

  def render_batch(
    self, camera: Camera, unit_from_camera: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray]:
    """Renders pictures of one camera at poses [N, 4, 4]: uint8 [N, H, W, 3], float32 [N, H, W]."""
    poses = np.ascontiguousarray(unit_from_camera, np.float32)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
      raise ValueError(f"Expected poses [N, 4, 4], found shape {poses.shape}.")
    rays = self._camera_rays(camera)
    shape = (len(poses), camera.height * camera.width)
    color = wp.empty((*shape, 3), dtype=wp.uint8, device=self._device.name)
    depth = wp.empty(shape, dtype=wp.float32, device=self._device.name)
    places = self._device.put(poses, wp.mat44)
    fixed = (self._data, self._march(camera.pixel_angle), places)

    def draw(first: int, last: int) -> None:
      inputs = [*fixed, rays[first:last], color[:, first:last], depth[:, first:last]]
      self._device.launch(self._kernels.frame, inputs, dim=(len(poses), last - first))

    self._share(draw, shape[1])
    size = (len(poses), camera.height, camera.width)
    return color.numpy().reshape(*size, 3), depth.numpy().reshape(size)

  def render_rays(
    self, origins: np.ndarray, directions: np.ndarray, pixel_angle: float
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Renders single rays.

    Args:
      origins: Start points [N, 3] in the unit frame.
      directions: Directions of unit length [N, 3].
      pixel_angle: Angle that a ray stands for [rad].

    Returns:
      Colour float32 [N, 3] (not clipped), distance of the median [N] (inf: none), opacity [N].
    """
    origins = np.ascontiguousarray(origins, np.float32)
    directions = np.ascontiguousarray(directions, np.float32)
    if origins.shape != directions.shape or origins.ndim != 2 or origins.shape[1] != 3:
      raise ValueError(
        f"Expected origins and directions [N, 3], found {origins.shape} and {directions.shape}."
      )
    lengths = np.linalg.norm(directions, axis=-1)
    if np.any(np.abs(lengths - 1) > 1e-3):
      raise ValueError(
        f"Directions must have unit length, found {lengths.min():.4g} to {lengths.max():.4g}."
      )
    count = len(origins)
    color = wp.empty((count, 3), dtype=wp.float32, device=self._device.name)
    distance = wp.empty(count, dtype=wp.float32, device=self._device.name)
    opacity = wp.empty(count, dtype=wp.float32, device=self._device.name)
    starts, ways = self._device.put(origins, wp.vec3), self._device.put(directions, wp.vec3)
    fixed = (self._data, self._march(pixel_angle))
    arrays = (starts, ways, color, distance, opacity)

    def draw(first: int, last: int) -> None:
      inputs = [*fixed, *(array[first:last] for array in arrays)]
      self._device.launch(self._kernels.rays, inputs, dim=last - first)

    self._share(draw, count)
    return color.numpy(), distance.numpy(), opacity.numpy()

  def _share(self, draw: Callable[[int, int], None], count: int) -> None:
    """Lets the threads draw equal parts of `count` rays."""
    stretches = self._device.share(count)
    self._device.run(lambda thread: draw(*stretches[thread]))

  def _upload_rays(self, camera: Camera) -> Any:
    rays = camera.rays().reshape(-1, 3).astype(np.float32)
    return self._device.put(rays, wp.vec3)

  def _march_data(self, pixel_angle: float) -> Any:
    how: Any = render_kernels.MarchData()
    how.distance = self._distance
    how.cells = self.occupancy.cells
    how.step = self.settings.step
    how.growth_steps = self.settings.growth_steps(pixel_angle)
    how.near, how.far = self.settings.near, self.settings.far
    how.stop, how.weight_floor = self.settings.stop, self.settings.weight_floor
    how.specular_samples = int(self.settings.specular_per_sample)
    how.pixel_angle = pixel_angle
    return how
