"""The renderer's reference in JAX: the same samples as the kernels, all of them, nothing skipped.

Plain and slow on purpose: tests compare the kernels with it. Shapes: R rays, S samples.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.field import encoding
from nerf2real.scenes.field.contraction import grid_coordinates
from nerf2real.scenes.field.field import Field, FieldSettings, Params, query
from nerf2real.scenes.field.occupancy import Occupancy
from nerf2real.scenes.field.render import renderer as render
from nerf2real.scenes.field.render.kernels import MEDIAN

_CHUNK = 1024  # rays at a time


def is_occupied(occupancy: Occupancy, points: np.ndarray) -> np.ndarray:
  """Looks up points of the unit frame [..., 3] in a grid: bool [...]."""
  cells, coordinates = occupancy.cells, np.asarray(grid_coordinates(jnp.asarray(points)))
  x, y, z = np.moveaxis(np.clip((coordinates * cells).astype(np.int32), 0, cells - 1), -1, 0)
  return occupancy.distance[z, y, x] == 0


def lattice(settings: render.RenderSettings, pixel_angle: float) -> tuple[np.ndarray, np.ndarray]:
  """Returns the distances of the samples [S] and the lengths of their intervals [S]."""
  growth = settings.growth_steps(pixel_angle)
  index = int(settings.near / settings.step)
  middles: list[float] = []
  lengths: list[float] = []
  while True:
    level = max(0, (index // growth).bit_length() - 1)
    index = (index >> level) << level
    middle = settings.step * (index + 0.5 * 2**level)
    if middle > settings.far:
      return np.array(middles), np.array(lengths)
    middles.append(middle)
    lengths.append(settings.step * 2**level)
    index += 2**level


def positions(origins: np.ndarray, directions: np.ndarray, distances: np.ndarray) -> np.ndarray:
  """Points of rays [R, 3] at distances [S]: [R, S, 3]."""
  return origins[:, None] + directions[:, None] * distances[:, None]


@functools.partial(jax.jit, static_argnums=0)
def composite(
  settings: FieldSettings,
  params: Params,
  points: jax.Array,
  directions: jax.Array,
  variances: jax.Array,
  lengths: jax.Array,
  occupied: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """Integrates samples [R, S]: colour [R, 3], opacity [R], transmittance before each [R, S + 1].

  w_i = T_i (1 - exp(-sigma_i l_i)), T_i = exp(-sum_{j < i} sigma_j l_j). Source: Mildenhall et al.
  2020, NeRF, equation 3.
  """
  spread = jnp.broadcast_to(directions[:, None], points.shape)
  density, color = query(settings, params, points, variances, spread)
  thickness = jnp.where(occupied, density, 0.0) * lengths
  passed = jnp.cumsum(thickness, axis=-1)
  before = jnp.exp(-jnp.concatenate([jnp.zeros_like(passed[:, :1]), passed], axis=-1))
  weights = before[:, :-1] - before[:, 1:]
  return jnp.sum(weights[..., None] * color, axis=1), 1.0 - before[:, -1], before


def render_rays(
  field: Field,
  occupancy: Occupancy | None,
  origins: np.ndarray,
  directions: np.ndarray,
  *,
  pixel_angle: float,
  settings: render.RenderSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Does what `Renderer.render_rays` does; no occupancy: samples everywhere."""
  distances, lengths = lattice(settings, pixel_angle)
  params = {name: jnp.asarray(value) for name, value in field.params.items()}
  colors, medians, opacities = [], [], []
  for first in range(0, len(origins), _CHUNK):
    origin, direction = origins[first : first + _CHUNK], directions[first : first + _CHUNK]
    points = positions(origin, direction, distances).astype(np.float32)
    occupied = np.ones(points.shape[:2], bool)
    if occupancy is not None:
      occupied = is_occupied(occupancy, points)
    trained = field.settings.march_step * np.maximum(np.abs(points).max(-1), 1)
    variances = encoding.sample_variance(
      jnp.broadcast_to(direction[:, None], points.shape),
      jnp.asarray(distances),
      jnp.asarray(trained),
      pixel_angle=pixel_angle,
    )
    color, opacity, before = composite(
      field.settings, params, points, direction, variances, lengths, occupied
    )
    before = np.asarray(before)
    colors.append(np.asarray(color))
    opacities.append(np.asarray(opacity))
    medians.append(_median(before, distances, lengths))
  return np.concatenate(colors), np.concatenate(medians), np.concatenate(opacities)


def _median(before: np.ndarray, distances: np.ndarray, lengths: np.ndarray) -> np.ndarray:
  """Distance [R] at which the transmittance [R, S + 1] falls to one half; inf if it does not."""
  crossed = before[:, 1:] <= MEDIAN
  which = crossed.argmax(-1)
  rows = np.arange(len(before))
  start, end = np.log(before[rows, which]), np.log(np.maximum(before[rows, which + 1], 1e-30))
  part = (start - np.log(MEDIAN)) / np.maximum(start - end, 1e-9)
  median = distances[which] + (part - 0.5) * lengths[which]
  return np.where(crossed.any(-1), median, np.inf)


def render_picture(
  field: Field,
  occupancy: Occupancy | None,
  camera: Camera,
  unit_from_camera: np.ndarray,
  *,
  settings: render.RenderSettings,
) -> tuple[np.ndarray, np.ndarray]:
  """Does what `Renderer.render` does: uint8 [H, W, 3], z-depth float32 [H, W]."""
  rays = camera.rays().reshape(-1, 3)
  slant = np.linalg.norm(rays, axis=-1)
  directions = (rays / slant[:, None]) @ unit_from_camera[:3, :3].T
  origins = np.broadcast_to(unit_from_camera[:3, 3], rays.shape)
  color, distance, _ = render_rays(
    field, occupancy, origins, directions, pixel_angle=camera.pixel_angle, settings=settings
  )
  size = (camera.height, camera.width)
  pixels = np.clip(color * 255 + 0.5, 0, 255).astype(np.uint8)
  return pixels.reshape(*size, 3), (distance / slant).reshape(size).astype(np.float32)
