"""A learned force: a smooth function of position and velocity, where no named effect fits."""

import numpy as np

from suite.effects.binding import Binding
from suite.effects.effect import Array, Effect, Kind, Operator, Parameter


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


class ResidualForce(Operator):
  """Force = sum_ij weights[i, j] basis_i(q) basis_j(v), one table a joint."""

  def bind(self, binding: Binding) -> None:
    self._tables: list[tuple[int | slice, dict[str, float], Array]] = []
    for effect in self.effects:
      grid = _grid(effect)
      shape = int(grid["num_positions"]), int(grid["num_velocities"])
      weights = np.asarray(effect.parameters.get("weights", []), np.float64)
      if not weights.size:
        continue
      if weights.size != shape[0] * shape[1]:
        raise ValueError(
          f"Found {weights.size} weights of a residual_force for {effect.target!r}, expected"
          f" num_positions * num_velocities = {shape[0] * shape[1]}."
        )
      for low, high in (("position_low", "position_high"), ("velocity_low", "velocity_high")):
        if not grid[low] < grid[high]:
          raise ValueError(f"Found {low} not below {high} in a residual_force, expected it to be.")
      self._tables.append((binding.joint_index(effect.target), grid, weights.reshape(shape)))

  def step(self, binding: Binding) -> None:
    for joints, grid, weights in self._tables:
      along_q, along_v = _along(binding.position[joints], binding.velocity[joints], grid)
      along_v *= along_q @ weights
      binding.force[joints] += np.add.reduce(along_v, axis=-1)


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
