"""The torque that a model lacks at every moment of a log, friction included: what the page shows.

    missing = (I + armature) a + damping v + drag |v| v + gravity + c + friction sign(v) - actuator

While a joint hardly moves, dry friction takes whatever it must up to its limit; what is left beyond
that is missing. Shapes: N samples.
"""

import numpy as np

from nerf2real.suite.effects.kinds import laws
from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.signatures import TorqueResidual
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.selection.search.evidence import Scored

Array = np.ndarray

_COGGING, _STRIBECK, _LOAD_FRICTION, _GEAR_LOAD = map(
  laws.over, (laws.cogging, laws.stribeck, laws.load_friction, laws.gear_load)
)
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
  needed -= _COGGING(r.position, value["amplitude"], value["periods"], value["phase"])
  limit = _friction(value, r, needed)
  moving = np.abs(r.velocity) > _AT_REST * np.quantile(np.abs(r.velocity), 0.98)
  sliding = needed + limit * np.sign(r.velocity)
  sticking = np.sign(needed) * np.maximum(np.abs(needed) - limit, 0.0)
  return r, np.where(moving, sliding, sticking)


def _friction(value: dict[str, float], r: TorqueResidual, needed: Array) -> Array:
  """Returns the limit of dry friction [N]."""
  motor = r.torque - value["damping"] * r.velocity
  load = _GEAR_LOAD(value["load_kind"], r.torque, motor, motor + needed)
  names = ("load_coefficient", "load_square", "load_at_rest", "load_velocity")
  rubbing = _LOAD_FRICTION(load, r.velocity, *(value[name] for name in names))
  falling = _STRIBECK(r.velocity, value["breakaway"], value["stribeck_velocity"])
  return value["friction"] + falling + rubbing
