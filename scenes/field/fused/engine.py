"""What fused training and evaluation share: parameters laid out for kernels, threads, occupancy.

Shapes: N samples or cells, L levels, T entries a level.
"""

import dataclasses
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from nerf2real.scenes.field.anchors import EMPTY_CELLS, empty_cells
from nerf2real.scenes.field.field import FieldSettings
from nerf2real.scenes.field.fused import kernels as fused_kernels
from nerf2real.scenes.field.fused import march as fused_march
from nerf2real.scenes.field.fused import network as fused_network
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.field.views import BlurPyramid, Views

_DISTANCE_CELLS = 12  # ours: empty space is skipped in strides of at most this many cells


def num_threads() -> int:
  """Threads to use: the cores that this process may run on."""
  return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def network_arrays(settings: FieldSettings, flat: np.ndarray) -> fused_network.Network:
  """Lays a flat vector out as the networks' parameters (the transposes are filled by `refresh`)."""
  shapes = {k: v for k, v in settings.shapes.items() if k != "table"}
  pieces, at = {}, 0
  for name, shape in shapes.items():
    size = int(np.prod(shape))
    pieces[name] = flat[at : at + size]
    at += size
  features = settings.levels * settings.features
  outputs = 4 + settings.bottleneck
  return fused_network.Network(
    **pieces,
    base_w1_t=np.zeros(settings.width * features, np.float32),
    base_w2_t=np.zeros(outputs * settings.width, np.float32),
    view_w1_t=np.zeros(settings.view_width * outputs, np.float32),
  )


def refresh(settings: FieldSettings, network: fused_network.Network) -> None:
  """Recomputes the transposed matrices from the parameters."""
  features = settings.levels * settings.features
  outputs, width, view = 4 + settings.bottleneck, settings.width, settings.view_width
  w1 = network.base_w1.reshape(features + 3, width)
  network.base_w1_t[:] = w1[:features].T.ravel()
  network.base_w2_t[:] = network.base_w2.reshape(width, outputs).T.ravel()
  transposed = network.view_w1_t.reshape(view, outputs)
  transposed[:, 4:] = network.view_w1.reshape(-1, view)[: settings.bottleneck].T


def flatten(settings: FieldSettings, params: dict[str, Any]) -> np.ndarray:
  """Packs the networks' parameters into one vector; view_w2 is transposed."""
  parts = []
  for name in settings.shapes:
    if name != "table":
      value = np.asarray(params[name], np.float32)
      parts.append((value.T if name == "view_w2" else value).ravel())
  return np.concatenate(parts)


def unflatten(settings: FieldSettings, flat: np.ndarray) -> dict[str, np.ndarray]:
  """Inverts `flatten`."""
  params, at = {}, 0
  for name, shape in settings.shapes.items():
    if name != "table":
      size = int(np.prod(shape))
      part = flat[at : at + size].copy()
      params[name] = part.reshape(3, -1).T.copy() if name == "view_w2" else part.reshape(shape)
      at += size
  return params


def check_supported(settings: FieldSettings) -> None:
  """Raises ValueError where the kernels cannot run a field of this shape."""
  features = settings.levels * settings.features
  wrong = [
    f"{name} = {value}"
    for name, value in (
      ("levels * features", features),
      ("width", settings.width),
      ("view_width", settings.view_width),
      ("4 + bottleneck", 4 + settings.bottleneck),
    )
    if value % 16
  ]
  if settings.features != 2:
    wrong.append(f"features = {settings.features}")
  if wrong:
    raise ValueError(
      f"The fused kernels need 2 features an entry and multiples of 16; found {', '.join(wrong)}. "
      'Change the field\'s settings or use engine="jax".'
    )


def make_chunk(settings: FieldSettings, *, samples: int, stored: int) -> fused_kernels.Chunk:
  """Allocates a thread's work arrays for chunks of `samples` and steps of `stored` samples."""
  n, r = samples, fused_kernels.CHUNK_RAYS
  width, view, outputs = settings.width, settings.view_width, 4 + settings.bottleneck
  features = settings.levels * settings.features
  sizes = {
    "distance": n,
    "length": n,
    "x": n * (features + 3),
    "pre": n * width,
    "hidden": n * width,
    "inverse_std": n,
    "out": n * outputs,
    "alpha": n,
    "view_pre": n * view,
    "view_hidden": n * view,
    "color": 6 * n,
    "d_color": 3 * n,
    "d_out": n * outputs,
    "d_hidden": n * width,
    "d_view": n * view,
    "weight": n,
    "through": n,
    "d_weight": n,
    "rays": 14 * r,
    "harmonics": 9 * r,
    "offsets": r * view,
    "d_rays": r * view,
    "coordinates": 3 * stored,
    "d_features": features * stored,
  }
  arrays = {name: np.zeros(size, np.float32) for name, size in sizes.items()}
  return fused_kernels.Chunk(
    ray_of=np.zeros(n, np.int64), first=np.zeros(r + 1, np.int64), **arrays
  )


def kernel_settings(
  field: FieldSettings, pixel_angle: float, train: TrainSettings
) -> fused_kernels.Settings:
  """Collects the numbers that the kernels need."""
  f = np.float32
  return fused_kernels.Settings(
    density_gain=f(field.density_gain),
    density_bias=f(field.density_bias),
    density_scale=f(field.density_scale),
    specular_bias=f(field.specular_bias),
    paper_footprint=field.footprint_rule == "paper",
    pixel_angle=f(pixel_angle),
    step=f(field.march_step),
    variance_step=f(field.march_step),
    near=f(train.near),
    depth_limit=f(train.depth_limit),
    ray_samples=train.ray_samples,
    charbonnier=f(train.charbonnier_padding),
    distortion=f(train.distortion_weight),
    blur_max=f(train.blur_max),
    blur_sharp=f(train.blur_sharp_fraction),
    blur_power=f(train.blur_power),
    random_background=train.random_background,
    anchor_fraction=f(train.anchor_fraction),
    anchor_weight=f(train.anchor_weight),
    empty_samples=train.empty_samples // num_threads(),
    empty_weight=f(train.empty_weight),
    empty_size=EMPTY_CELLS,
  )


def make_pictures(views: Views, *, blur_max: float) -> fused_kernels.Pictures:
  """Lays pictures, their blurred copies and poses out for the kernels."""
  pyramid = BlurPyramid.build(views, blur_max=blur_max)
  sizes = [level.size for level in pyramid.levels]
  return fused_kernels.Pictures(
    pixels=np.concatenate([level.ravel() for level in pyramid.levels]),
    starts=np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
    heights=np.array([level.shape[1] for level in pyramid.levels], np.int64),
    widths=np.array([level.shape[2] for level in pyramid.levels], np.int64),
    factors=np.array(pyramid.factors, np.float32),
    blurs=np.array(pyramid.blurs, np.float32),
    directions=views.camera.rays().astype(np.float32).ravel(),
    rotations=views.world_from_camera[:, :3, :3].astype(np.float32).ravel(),
    origins=views.world_from_camera[:, :3, 3].astype(np.float32).ravel(),
    anchors=views.anchors.astype(np.float32).ravel(),
    empty=empty_cells(views),
  )


def full_occupancy(inner: int, outer: int, density: float) -> fused_march.Occupancy:
  """Returns grids where every cell is occupied with a density."""
  return fused_march.Occupancy(
    inner,
    np.zeros(inner**3, np.uint8),
    np.full(inner**3, density, np.float32),
    outer,
    np.zeros(outer**3, np.uint8),
    np.full(outer**3, density, np.float32),
  )


def cell_positions(cells: np.ndarray, size: int, jitter: np.ndarray, *, inner: bool) -> np.ndarray:
  """Points [N, 3] in the unit frame inside grid cells, at `jitter` [N, 3] in [0, 1) of the cell."""
  index = np.stack([cells // (size * size), cells // size % size, cells % size], axis=-1)
  unit = (index + jitter) / size
  if inner:
    return (2 * unit - 1).astype(np.float32)
  squashed = np.clip(4 * unit - 2, -1.98, 1.98)
  norm = np.maximum(np.abs(squashed).max(-1, keepdims=True), 1.0)
  return (squashed / (norm * (2 - norm))).astype(np.float32)


@dataclasses.dataclass
class Engine:
  """What training and evaluation share: arrays for the kernels and a pool of threads."""

  settings: FieldSettings
  kernel: fused_kernels.Settings
  table: np.ndarray
  network: fused_network.Network
  occupancy: fused_march.Occupancy
  chunks: list[fused_kernels.Chunk]
  pool: ThreadPoolExecutor

  @property
  def resolutions(self) -> np.ndarray:
    return np.array(self.settings.resolutions, np.int64)

  @property
  def entries(self) -> int:
    return 2**self.settings.log2_table_size

  def run(self, work: Callable[[int], Any]) -> list[Any]:
    """Runs work(thread) on every thread and waits; an exception of any is raised."""
    return list(self.pool.map(work, range(len(self.chunks))))

  def densities(self, positions: np.ndarray, *, sigma: float) -> np.ndarray:
    """Densities [N] at positions [N, 3] averaged over a standard deviation [unit]."""
    flat = np.ascontiguousarray(positions, np.float32).ravel()
    result = np.empty(len(flat) // 3, np.float32)
    bounds = np.linspace(0, len(result), len(self.chunks) + 1).astype(np.int64)

    def work(thread):
      fused_kernels.densities(
        self.kernel,
        self.network,
        self.table,
        self.resolutions,
        self.entries,
        self.chunks[thread],
        flat,
        np.float32(sigma**2),
        bounds[thread],
        bounds[thread + 1],
        result,
      )

    self.run(work)
    return result

  def update_occupancy(
    self, cells: np.ndarray, rng: np.random.Generator, *, inner: bool, decay: float
  ) -> None:
    """Looks at cells [N] of a grid: density = max(decay * density, field there)."""
    occupancy = self.occupancy
    size = occupancy.inner_size if inner else occupancy.outer_size
    grid = occupancy.inner_density if inner else occupancy.outer_density
    jitter = rng.random((len(cells), 3), np.float32)
    positions = cell_positions(cells, size, jitter, inner=inner)
    seen = self.densities(positions, sigma=self.settings.march_step / np.sqrt(12))
    grid[cells] = np.maximum(grid[cells] * np.float32(decay), seen)

  def refresh_distances(self, *, threshold: float) -> None:
    """Recomputes which cells are occupied and how far the others are from those."""
    occupancy = self.occupancy
    density = -np.log1p(-threshold) / self.settings.march_step
    occupied = occupancy.inner_density > density
    occupancy.inner_distance[:] = fused_march.chebyshev_distance(
      occupied.reshape((occupancy.inner_size,) * 3), limit=_DISTANCE_CELLS
    ).ravel()
    # Outside, a step's length grows with the distance as a cell's does: the same threshold holds.
    occupied = occupancy.outer_density > density
    occupancy.outer_distance[:] = fused_march.chebyshev_distance(
      occupied.reshape((occupancy.outer_size,) * 3), limit=_DISTANCE_CELLS
    ).ravel()
