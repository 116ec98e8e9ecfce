"""Projects 3D Gaussians to 2D Gaussians in a picture (EWA splatting), in JAX.

Source: Zwicker et al. 2001, EWA volume splatting, equations 24 to 31, as Kerbl et al. 2023 use
them. Shapes: N splats.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.core.cameras import Camera

_NEAR = 0.05  # nearer splats are not drawn [m]
_SLOPE_LIMIT = 1.3  # of the half field of view, where the affine approximation is taken at last


class Parameters(NamedTuple):
  """What is fitted; every entry is unbounded. Packed, they are the columns of one array [N, 14]."""

  offsets: jax.Array  # of the positions from their start, in units of the splats' spacing [N, 3]
  log_scales: jax.Array  # logarithms of the standard deviations [N, 3] [m]
  rotations: jax.Array  # quaternions of any length (w, x, y, z) [N, 4]
  logits: jax.Array  # of the opacities [N]
  colors: jax.Array  # [N, 3]

  @classmethod
  def of_rows(cls, rows: jax.Array) -> "Parameters":
    """Splits packed rows [N, 14]."""
    return cls(rows[:, :3], rows[:, 3:6], rows[:, 6:10], rows[:, 10], rows[:, 11:])


class Eye(NamedTuple):
  """A pinhole camera at a place."""

  rotation: np.ndarray  # camera from world [3, 3], OpenCV axes
  translation: np.ndarray  # [3] m
  focal: np.ndarray  # fx, fy [pixel]
  centre: np.ndarray  # cx, cy [pixel]
  slope: np.ndarray  # tangents of the half field of view, x and y
  blur: np.ndarray  # variance added to every 2D Gaussian [pixel^2]

  @classmethod
  def at(cls, camera: Camera, world_from_camera: np.ndarray, *, blur: float) -> "Eye":
    """Returns the eye of a camera without distortion at a pose [4, 4]."""
    rotation = world_from_camera[:3, :3].T
    focal = np.array([camera.fx, camera.fy])
    values = (
      rotation,
      -rotation @ world_from_camera[:3, 3],
      focal,
      np.array([camera.cx, camera.cy]),
      0.5 * np.array([camera.width, camera.height]) / focal,
      np.array(blur),
    )
    return cls(*(np.asarray(value, np.float32) for value in values))


class Projected(NamedTuple):
  """2D Gaussians."""

  centres: jax.Array  # [N, 2] pixel
  conics: jax.Array  # inverse covariances: xx, xy, yy [N, 3]
  opacities: jax.Array  # [N]
  colors: jax.Array  # [N, 3]


def axes(rotations: jax.Array) -> jax.Array:
  """Rotation matrices [N, 3, 3] of quaternions [N, 4] of any length."""
  w, x, y, z = jnp.moveaxis(rotations / jnp.linalg.norm(rotations, axis=-1, keepdims=True), -1, 0)
  rows = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ]
  return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def project(
  rows: jax.Array, starts: jax.Array, spacing: jax.Array, eye: Eye
) -> tuple[Projected, jax.Array]:
  """Projects splats.

  Args:
    rows: Packed parameters [N, 14].
    starts: Positions that the offsets are from [N, 3] [m].
    spacing: Unit of the offsets [N] [m].
    eye: Where from.

  Returns:
    The 2D Gaussians, and the depths [N] [m]; 0 for splats that are not before the camera.
  """
  parameters = Parameters.of_rows(rows)
  positions = starts + spacing[:, None] * parameters.offsets
  local = positions @ eye.rotation.T + eye.translation
  depth = local[:, 2]
  ahead = depth > _NEAR
  z = jnp.where(ahead, depth, 1.0)
  plane = local[:, :2] / z[:, None]
  limit = _SLOPE_LIMIT * eye.slope
  bounded = jnp.clip(plane, -limit, limit)
  spread = (eye.rotation @ axes(parameters.rotations)) * jnp.exp(parameters.log_scales)[:, None]
  # rows of the projection's Jacobian times the Gaussian's axes [N, 3] each
  across = (spread[:, 0] - bounded[:, :1] * spread[:, 2]) * (eye.focal[0] / z)[:, None]
  down = (spread[:, 1] - bounded[:, 1:] * spread[:, 2]) * (eye.focal[1] / z)[:, None]
  xx = (across * across).sum(-1) + eye.blur
  xy = (across * down).sum(-1)
  yy = (down * down).sum(-1) + eye.blur
  determinant = jnp.maximum(xx * yy - xy * xy, 1e-9)
  conics = jnp.stack([yy, -xy, xx], -1) / determinant[:, None]
  centres = plane * eye.focal + eye.centre
  gaussians = Projected(centres, conics, jax.nn.sigmoid(parameters.logits), parameters.colors)
  return gaussians, jnp.where(ahead, depth, 0.0)
