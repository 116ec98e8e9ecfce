"""A learned force: a smooth function of position and velocity, where no named effect fits."""

import numpy as np

from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Array, Effect, Kind, Operator, Parameter


def basis(value: Array, low: float, high: float, *, count: int) -> Array:
  """Returns normalised Gaussian bumps on an even grid: [..., count], summing to 1.

  Width is the grid's spacing. Outside [low, high] the value at the end is taken.

  Args:
    value: where [...].
    low: first centre.
    high: last centre.
    count: number of bumps; 1 gives the constant 1.
  """
  if count == 1:
    return np.ones((*np.shape(value), 1))
  place = (np.asarray(value, np.float64) - low) * ((count - 1) / (high - low))
  place = np.minimum(np.maximum(place, 0.0), count - 1.0)
  bumps = place[..., None] - np.arange(float(count))
  bumps *= bumps
  bumps *= -0.5
  np.exp(bumps, out=bumps)
  bumps /= np.add.reduce(bumps, axis=-1, keepdims=True)
  return bumps


def features(position: Array, velocity: Array, effect: Effect) -> Array:
  """Returns the features [N, positions * velocities] whose product with the weights is the force.

  Linear in the weights, so that a fit is a least-squares problem.
  """
  grid = _grid(effect)
  along_q, along_v = _along(position, velocity, grid)
  return (along_q[..., :, None] * along_v[..., None, :]).reshape(*np.shape(position), -1)


def _grid(effect: Effect) -> dict[str, float]:
  names = [p.name for p in KINDS[0].parameters if not p.is_list]
  return {n: float(effect.parameters.get(n, KINDS[0].parameter(n).nominal)) for n in names}  # type: ignore


def _along(position: Array, velocity: Array, grid: dict[str, float]) -> tuple[Array, Array]:
  positions, velocities = int(grid["num_positions"]), int(grid["num_velocities"])
  return (
    basis(position, grid["position_low"], grid["position_high"], count=positions),
    basis(velocity, grid["velocity_low"], grid["velocity_high"], count=velocities),
  )


class _Table:
  """One residual_force made ready: both bases are evaluated in one pass over [2, J, grid]."""

  def __init__(self, effect: Effect, joints: int | slice):
    grid = _grid(effect)
    counts = np.array([int(grid["num_positions"]), int(grid["num_velocities"])])
    weights = np.asarray(effect.parameters.get("weights", []), np.float64)
    if weights.size != counts.prod():
      raise ValueError(
        f"Found {weights.size} weights of a residual_force for {effect.target!r}, expected"
        f" num_positions * num_velocities = {counts.prod()}."
      )
    low = np.array([grid["position_low"], grid["velocity_low"]])
    high = np.array([grid["position_high"], grid["velocity_high"]])
    if not (low < high).all():
      raise ValueError("Found a low bound not below the high one in a residual_force.")
    self.joints = joints
    self._low, self._scale = low[:, None], ((counts - 1) / (high - low))[:, None]
    self._last = (counts - 1.0)[:, None]
    size = counts.max()
    self._centres = np.arange(float(size))
    self._used = (self._centres < counts[:, None])[:, None, :].astype(float)
    self._weights = np.zeros((size, size))
    self._weights[: counts[0], : counts[1]] = weights.reshape(counts)

  def force(self, position: Array, velocity: Array) -> Array:
    """Returns the force [J] at positions and velocities [J]."""
    place = np.stack([np.atleast_1d(position), np.atleast_1d(velocity)])
    place -= self._low
    place *= self._scale
    np.maximum(place, 0.0, out=place)
    np.minimum(place, self._last, out=place)
    bumps = place[:, :, None] - self._centres
    bumps *= bumps
    bumps *= -0.5
    np.exp(bumps, out=bumps)
    bumps *= self._used
    total = np.add.reduce(bumps, axis=2)
    product = bumps[0] @ self._weights
    product *= bumps[1]
    return np.add.reduce(product, axis=1) / (total[0] * total[1])


class ResidualForce(Operator):
  """Force = sum_ij weights[i, j] basis_i(q) basis_j(v), one table a joint."""

  def bind(self, binding: Binding) -> None:
    self._tables = [
      _Table(effect, binding.joint_index(effect.target))
      for effect in self.effects
      if np.size(effect.parameters.get("weights", []))
    ]

  def step(self, binding: Binding) -> None:
    for table in self._tables:
      force = table.force(binding.position[table.joints], binding.velocity[table.joints])
      binding.force[table.joints] += force if isinstance(table.joints, slice) else force[0]


def _bound(name: str, unit: str, value: float, doc: str) -> Parameter:
  return Parameter(name, unit, value, -10.0, 10.0, doc, shape=True, fitted=False)


def _count(name: str, value: float) -> Parameter:
  return Parameter(name, "1", value, 1, 20, "grid points", minimum=1, shape=True, fitted=False)


KINDS = (
  Kind(
    "residual_force",
    "a learned smooth force over position and velocity",
    "joint",
    "force",
    (
      Parameter(
        "weights", "N m", 0.0, -1.0, 1.0, "forces at the grid points, position-major", is_list=True
      ),
      _count("num_positions", 5.0),
      _count("num_velocities", 5.0),
      _bound("position_low", "rad", -1.5, "first grid point in position"),
      _bound("position_high", "rad", 1.5, "last grid point in position"),
      _bound("velocity_low", "rad/s", -5.0, "first grid point in velocity"),
      _bound("velocity_high", "rad/s", 5.0, "last grid point in velocity"),
    ),
    ResidualForce,
  ),
)
