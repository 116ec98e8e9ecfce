"""The torque that a model lacks at every moment of a log, friction included: what the page shows.

    missing = (I + armature) a + damping v + drag |v| v + gravity + c + friction sign(v) - actuator

While a joint hardly moves, dry friction takes whatever it must up to its limit; what is left beyond
that is missing. Shapes: N samples.
"""

import numpy as np

from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.signatures import TorqueResidual
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.selection.evidence import Scored

Array = np.ndarray

_AT_REST = 0.02  # of the usual highest speed, below which a joint may stick; ours


def missing_torque(plant: JointModel, item: Scored, index: int) -> tuple[TorqueResidual, Array]:
  """Returns a log's regressors and the missing torque [N] at the same samples.

  Args:
    plant: the joint.
    item: a hypothesis.
    index: of the log.
  """
  hypothesis = compose(plant, item.terms, item.fit.x)
  r = signatures.torque_residual(plant, hypothesis, index)
  value = dict(zip(INDEX, hypothesis.p, strict=True))
  needed = -r.residual + value["drag"] * np.abs(r.velocity) * r.velocity
  needed -= value["amplitude"] * np.sin(value["periods"] * r.position + value["phase"])
  limit = _friction(value, r, needed)
  moving = np.abs(r.velocity) > _AT_REST * np.quantile(np.abs(r.velocity), 0.98)
  sliding = needed + limit * np.sign(r.velocity)
  sticking = np.sign(needed) * np.maximum(np.abs(needed) - limit, 0.0)
  return r, np.where(moving, sliding, sticking)


def _friction(value: dict[str, float], r: TorqueResidual, needed: Array) -> Array:
  """Returns the limit of dry friction [N]."""
  ratio = r.velocity / max(value["stribeck_velocity"], 1e-6)
  limit = value["friction"] + value["breakaway"] * np.exp(-(ratio**2))
  carried = r.torque
  if value["load_kind"] == 1:
    carried = r.torque - value["damping"] * r.velocity
  elif value["load_kind"] == 2:
    carried = r.torque + needed - value["damping"] * r.velocity
  size = np.abs(carried)
  if value["load_kind"] >= 3:
    motor = r.torque - value["damping"] * r.velocity
    sides = np.abs([motor, motor + needed])
    size = sides.max(axis=0) if value["load_kind"] == 3 else sides.mean(axis=0)
  rubbing = (value["load_coefficient"] + value["load_square"] * size) * size
  fall = r.velocity / max(value["load_velocity"], 1e-6)
  return limit + rubbing * (1.0 + value["load_at_rest"] * np.exp(-(fall**2)))
