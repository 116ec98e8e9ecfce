"""Effects that are a force over position and velocity, as terms and as the kernel's table.

Shapes: P places along the position, V along the velocity.
"""

import numpy as np

from nerf2real.suite.effects import Kind, kind_of
from nerf2real.suite.effects.kinds import laws
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import Table
from nerf2real.sysid.model.plant import JointPlant

Array = np.ndarray

_PLACES = 161
"""Along each axis, a margin of one at both ends; chosen: free forces have as many."""
_BEYOND = 0.1  # of the range of the logs by which a simulation may leave it, chosen
_STARTS = (0.25, 0.5)  # of the way from a range's lower end to its upper, chosen
_SCALE = 0.1  # of the range


def term_of(plant: JointPlant, kind: Kind) -> Term:
  """Returns the candidate of a kind at a joint: its parameters, searched within their ranges."""
  fitted = [p for p in kind.parameters if p.fitted]
  low, high = (np.array([getattr(p, end) for p in fitted]) for end in ("low", "high"))
  starts = tuple(tuple(map(float, low + share * (high - low))) for share in _STARTS)
  return Term(
    kind.name,
    plant.joint,
    tuple(p.name for p in fitted),
    tuple(map(float, low)),
    tuple(map(float, high)),
    tuple(map(float, _SCALE * (high - low))),
    starts,
    fixed=tuple((p.name, p.nominal) for p in kind.parameters if not p.fitted),
  )


def add(plant: JointPlant, term: Term, values: dict[str, float], table: Table | None) -> Table:
  """Returns the kernel's table of an effect's force, with another's force in it."""
  kind = kind_of(term.kind)
  weights, bounds = _blank(plant) if table is None else table
  q = _places(bounds[0], bounds[1], weights.shape[0])
  v = _places(bounds[2], bounds[3], weights.shape[1])
  law = laws.over(kind.law)
  force = law(q[:, None], v[None], *(values[p.name] for p in kind.parameters))
  return weights + force, bounds


def _blank(plant: JointPlant) -> Table:
  """Returns a table without force over the positions and velocities of a joint's logs."""
  bounds = []
  for rows in ([log.position for log in plant.logs], [log.velocity for log in plant.logs]):
    values = np.concatenate(rows)
    margin = max(_BEYOND * float(np.ptp(values)), 1e-6)
    bounds += [float(values.min()) - margin, float(values.max()) + margin]
  return np.zeros((_PLACES, _PLACES)), np.array(bounds)


def _places(low: float, high: float, count: int) -> Array:
  """Returns where the weights along an axis are, one place beyond either end."""
  return low + (np.arange(count) - 1.0) * (high - low) / (count - 3)
