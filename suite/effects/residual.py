"""A learned force: a smooth function of position and velocity, where no named effect fits."""

import numpy as np

from suite.effects.binding import Binding
from suite.effects.effect import Array, Effect, Kind, Operator, Parameter


def basis(value: Array, low: Array, high: Array, *, count: int) -> Array:
  """Returns normalised Gaussian bumps on an even grid: [..., count], summing to 1.

  Width is the grid's spacing. Outside [low, high] the value at the end is taken.

  Args:
    value: where [...].
    low: first centre [...] or scalar.
    high: last centre.
    count: number of bumps; 1 gives the constant 1.
  """
  value = np.asarray(value, np.float64)
  if count == 1:
    return np.ones((*value.shape, 1))
  place = np.clip((value - low) / (high - low), 0.0, 1.0) * (count - 1)
  bumps = np.exp(-0.5 * np.square(place[..., None] - np.arange(count)))
  return bumps / bumps.sum(-1, keepdims=True)


def features(position: Array, velocity: Array, effect: Effect) -> Array:
  """Returns the features [N, positions * velocities] whose product with the weights is the force.

  Linear in the weights, so that a fit is a least-squares problem.
  """
  value = {p.name: p.nominal for p in KINDS[0].parameters if not p.is_list} | dict(
    effect.parameters
  )
  along_q = basis(
    position, value["position_low"], value["position_high"], count=int(value["num_positions"])
  )
  along_v = basis(
    velocity, value["velocity_low"], value["velocity_high"], count=int(value["num_velocities"])
  )
  return (along_q[..., :, None] * along_v[..., None, :]).reshape(*np.shape(position), -1)


class ResidualForce(Operator):
  """Force = sum_ij weights[i, j] basis_i(q) basis_j(v), one table a joint."""

  def bind(self, binding: Binding) -> None:
    self._tables: list[tuple[Array, Effect, Array]] = []
    for effect in self.effects:
      joints = np.arange(len(binding.joints))[binding.joint_index(effect.target)].reshape(-1)
      weights = np.asarray(effect.parameters.get("weights", []), np.float64)
      count = int(self.value(effect, "num_positions")) * int(self.value(effect, "num_velocities"))
      if not weights.size:
        continue
      if weights.size != count:
        raise ValueError(
          f"Found {weights.size} weights of a residual_force for {effect.target!r}, expected"
          f" num_positions * num_velocities = {count}."
        )
      for low, high in (("position_low", "position_high"), ("velocity_low", "velocity_high")):
        if not self.value(effect, low) < self.value(effect, high):
          raise ValueError(f"Found {low} not below {high} in a residual_force, expected it to be.")
      self._tables.append((joints, effect, weights.reshape(-1)))

  def step(self, binding: Binding) -> None:
    for joints, effect, weights in self._tables:
      q, v = binding.position[joints], binding.velocity[joints]
      binding.force[joints] += features(q, v, effect) @ weights


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
