"""Projection of splats in JAX, whose derivatives are the oracle of the written ones."""

import functools

import jax
import jax.numpy as jnp

from nerf2real.scenes.export.splats.projection import FAINTEST, Eye, Projected


def axes(rotations):
  """Rotation matrices [N, 3, 3] of quaternions [N, 4] of any length."""
  w, x, y, z = jnp.moveaxis(rotations / jnp.linalg.norm(rotations, axis=-1, keepdims=True), -1, 0)
  rows = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ]
  return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


@jax.jit
def project(rows, starts, spacing, eye: Eye) -> Projected:
  """The responses of splats that lie before the camera, by the inverse of their axes."""
  positions = starts + spacing[:, None] * rows[:, :3]
  local = positions @ eye.rotation.T + eye.translation
  plane = local[:, :2] / local[:, 2:]
  spread = (eye.rotation @ axes(rows[:, 6:10])) * jnp.exp(rows[:, 3:6])[:, None]
  to_round = jnp.linalg.inv(spread)  # in this frame the splat is a unit ball
  ray = to_round @ jnp.concatenate([plane, jnp.ones_like(plane[:, :1])], -1)[..., None]
  ray, right, down = ray[..., 0], to_round[..., 0] / eye.focal[0], to_round[..., 1] / eye.focal[1]
  square = (ray * ray).sum(-1)
  bends = jnp.stack(
    [(a * b).sum(-1) / square for a, b in ((ray, right), (ray, down), (right, right))]
    + [(a * b).sum(-1) / square for a, b in ((right, down), (down, down))],
    -1,
  )
  # the part of a step across the ray that leaves its direction, at the centre's distance
  across, along = local[:, 2:] * right, local[:, 2:] * down
  across -= (across * ray).sum(-1, keepdims=True) / square[:, None] * ray
  along -= (along * ray).sum(-1, keepdims=True) / square[:, None] * ray
  conics = jnp.stack([(across**2).sum(-1), (across * along).sum(-1), (along**2).sum(-1)], -1)
  centres = plane * eye.focal + eye.centre
  return Projected(centres, conics, bends, jax.nn.sigmoid(rows[:, 10]), rows[:, 11:])


@jax.jit
def pull(rows, starts, spacing, eye: Eye, slopes: Projected):
  """Derivatives [N, 14] of a loss by the packed parameters, of those by the responses."""
  return jax.vjp(lambda r: project(r, starts, spacing, eye), rows)[1](slopes)[0]


@functools.partial(jax.jit, static_argnames=("width", "height"))
def render(rows, starts, spacing, eye: Eye, *, width: int, height: int):
  """The picture [H, W, 3] by its definition: every splat's nearest point to every ray, sorted."""
  positions = starts + spacing[:, None] * rows[:, :3]
  local = positions @ eye.rotation.T + eye.translation
  spread = (eye.rotation @ axes(rows[:, 6:10])) * jnp.exp(rows[:, 3:6])[:, None]
  to_round = jnp.linalg.inv(spread)
  x, y = jnp.meshgrid(jnp.arange(width) + 0.5, jnp.arange(height) + 0.5)
  rays = jnp.stack(
    [(x - eye.centre[0]) / eye.focal[0], (y - eye.centre[1]) / eye.focal[1], jnp.ones_like(x)], -1
  )
  ways = jnp.einsum("nij,hwj->hwni", to_round, rays)
  centre = jnp.einsum("nij,nj->ni", to_round, local)
  reach = (ways * centre).sum(-1) / (ways * ways).sum(-1)
  power = 0.5 * jnp.square(ways * reach[..., None] - centre).sum(-1)
  alpha = jax.nn.sigmoid(rows[:, 10]) * jnp.exp(-power)
  alpha = jnp.where(alpha < FAINTEST, 0.0, jnp.minimum(alpha, 0.99))
  order = jnp.argsort(reach, axis=-1)
  alpha = jnp.take_along_axis(alpha, order, -1)
  light = jnp.cumprod(1 - alpha, -1) / (1 - alpha)
  return jnp.einsum("hwn,hwnk->hwk", alpha * light, rows[:, 11:][order])
