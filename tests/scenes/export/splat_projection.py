"""Projection of splats in JAX, whose derivatives are the oracle of the written ones."""

import jax
import jax.numpy as jnp

from nerf2real.scenes.export.splats.projection import NEAR, SLOPE_LIMIT, Eye, Projected


def axes(rotations):
  """Rotation matrices [N, 3, 3] of quaternions [N, 4] of any length."""
  w, x, y, z = jnp.moveaxis(rotations / jnp.linalg.norm(rotations, axis=-1, keepdims=True), -1, 0)
  rows = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ]
  return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def project(rows, starts, spacing, eye: Eye) -> Projected:
  """The 2D Gaussians of splats that lie before the camera."""
  positions = starts + spacing[:, None] * rows[:, :3]
  local = positions @ eye.rotation.T + eye.translation
  z = jnp.where(local[:, 2] > NEAR, local[:, 2], 1.0)
  plane = local[:, :2] / z[:, None]
  limit = SLOPE_LIMIT * eye.slope
  bounded = jnp.clip(plane, -limit, limit)
  spread = (eye.rotation @ axes(rows[:, 6:10])) * jnp.exp(rows[:, 3:6])[:, None]
  # rows of the projection's Jacobian times the Gaussian's axes [N, 3] each
  across = (spread[:, 0] - bounded[:, :1] * spread[:, 2]) * (eye.focal[0] / z)[:, None]
  down = (spread[:, 1] - bounded[:, 1:] * spread[:, 2]) * (eye.focal[1] / z)[:, None]
  xx = (across * across).sum(-1) + eye.blur
  xy = (across * down).sum(-1)
  yy = (down * down).sum(-1) + eye.blur
  conics = jnp.stack([yy, -xy, xx], -1) / (xx * yy - xy * xy)[:, None]
  centres = plane * eye.focal + eye.centre
  return Projected(centres, conics, jax.nn.sigmoid(rows[:, 10]), rows[:, 11:])


def pull(rows, starts, spacing, eye: Eye, slopes: Projected):
  """Derivatives [N, 14] of a loss by the packed parameters, of those by the 2D Gaussians."""
  return jax.vjp(lambda r: project(r, starts, spacing, eye), rows)[1](slopes)[0]
