"""A force over position and velocity of any smooth form: what no name is needed for.

    F(q, v) = sum over k, m of c_km cos(pi k q') cos(pi m v'),  q' and v' from 0 to 1 over the range

over the hyperbolic cross (1 + k)(1 + m) <= K: fine along one axis or coarse along both. c_km is
normal about zero with a deviation that falls as those of a step do, 1 / (1 + k + m). Where
it predicts left-out motion better than all named effects, something is there that they are not.
"""

from typing import Any

import numpy as np

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses.candidates import typical_torque
from nerf2real.sysid.hypotheses.terms import FREE, Term
from nerf2real.sysid.model.plant import JointPlant

Array = np.ndarray

_CROSS = 14
"""K, chosen: half waves down to a thirteenth of a joint's range, with 41 values."""
_ORDERS = [(k, m) for k in range(_CROSS) for m in range(_CROSS) if (1 + k) * (1 + m) <= _CROSS]
_GRID = 20
"""Places of the weights along each axis: as many as `suite.effects.residual_force` takes."""
_FINE = 8
"""Parts of a bump's width between places of the table: a cubic between them is right to 2e-5."""
_WAVES = np.cos(np.pi * np.arange(_CROSS)[None] * np.linspace(0.0, 1.0, _GRID)[:, None])
_PLACES = np.arange(-1.0, (_GRID - 1) * _FINE + 2) / _FINE
_BUMPS = np.exp(-0.5 * (_PLACES[:, None] - np.arange(_GRID)[None]) ** 2)
_BUMPS /= _BUMPS.sum(axis=1, keepdims=True)


VARIABLE = {
  **dict.fromkeys(("spring", "cogging", "gravity_tilt"), "position"),
  **dict.fromkeys(
    ("viscous_friction", "quadratic_drag", "coulomb_friction", "asymmetric_friction"), "velocity"
  ),
  "stribeck_friction": "velocity",
}
"""Kinds that are a force over one variable alone."""


def free_force(plant: JointPlant, along: str | None = None) -> Term:
  """Returns the force with its prior, as large as the torque that the joint works at.

  Args:
    plant: the joint.
    along: "position" or "velocity" for a force over that alone.
  """
  orders = [o for o in _ORDERS if along is None or o[1 if along == "position" else 0] == 0]
  q = np.concatenate([log.position for log in plant.logs])
  v = np.concatenate([log.velocity for log in plant.logs])
  fast = max(float(np.quantile(np.abs(v), 0.995)), 1e-6)
  low, high = float(q.min()), float(max(q.max(), q.min() + 1e-6))
  size = typical_torque(plant)
  sigma = tuple(size / (1.0 + k + m) for k, m in orders)
  count = len(orders)
  return Term(
    FREE,
    plant.joint,
    tuple(f"c{k}_{m}" for k, m in orders),
    (-5.0 * size,) * count,
    (5.0 * size,) * count,
    sigma,
    ((0.0,) * count,),
    sigma,
    (0.0,) * count,
    fixed=(
      ("position_low", low),
      ("position_high", high),
      ("velocity_low", -fast),
      ("velocity_high", fast),
    ),
  )


def weights(term: Term, x: Array) -> Array:
  """Returns the weights [P, V] of the suite's bumps."""
  orders = np.zeros((_CROSS, _CROSS))
  orders[tuple(np.array([[int(part) for part in n[1:].split("_")] for n in term.names]).T)] = x
  return _WAVES @ orders @ _WAVES.T


def table(term: Term, x: Array) -> tuple[Array, Array]:
  """Returns the kernel's table: forces at even places with a margin of one, and bounds [4]."""
  return _BUMPS @ weights(term, x) @ _BUMPS.T, np.array([value for _, value in term.fixed])


def effect(term: Term, x: Array) -> Effect:
  """Returns the force as an effect, of which nothing is left to fit."""
  grid = {"num_positions": _GRID, "num_velocities": _GRID}
  values: dict[str, Any] = {"weights": [float(w) for w in weights(term, x).ravel()]}
  values |= grid | dict(term.fixed)
  return Effect(FREE, term.target, values)
