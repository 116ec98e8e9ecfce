"""Torques of a declared model that the simulation of one joint holds no law of.

What that simulation leaves out of a model makes a healthy machine look as if it had an effect. So
the forces that MuJoCo has at the readings of a log are compared with what the joint's parameters
say: an actuator's, springs', dampers', and those of constraints, of which it holds dry friction.
"""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model.drive import Told, actuator_of
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.motion import smooth_motion
from nerf2real.sysid.model.plant import declared_parameters
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

_LARGEST = 0.5 * dict(SETTINGS.tolerances)["gain"]
"""Share of a joint's torque that may lack a law: half of what a declared gain may be off."""
_READINGS = 1000  # of a log that are looked at, evenly spaced; chosen

_ROWS = {
  "contacts": (
    mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS,
    mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL,
    mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC,
  ),
  "the end of its range, where the logs have it": (mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT,),
  "a tendon that holds it": (
    mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON,
    mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON,
  ),
  "an equality constraint": (mujoco.mjtConstraint.mjCNSTR_EQUALITY,),
}
"""Rows of constraints [mjtConstraint] by what they are of; friction of a joint is held."""
_OWN = (
  "a fluid's forces",
  "springs beyond one of its own (of tendons, or further coefficients)",
  "damping beyond one of its own (of actuators or tendons, or further coefficients)",
  "an actuator's force that is no motor's and no servo's",
)


def unheld(model: mujoco.MjModel, logs: Sequence[Log]) -> dict[str, str]:
  """Returns which commanded joints have torques without a law under the logs, and of what most are.

  Args:
    model: compiled; of a machine on a stand.
    logs: of its joints.
  """
  whole: dict[str, float] = {}
  lacking: dict[str, Array] = {}
  for log in logs:
    for name, (total, parts) in _squares(model, log).items():
      whole[name] = whole.get(name, 0.0) + total
      lacking[name] = lacking.get(name, np.zeros(len(parts))) + parts
  return {
    name: (*_OWN, *_ROWS)[int(np.argmax(parts))]
    for name, parts in lacking.items()
    if parts.max() > _LARGEST**2 * whole[name]
  }


def _squares(model: mujoco.MjModel, log: Log) -> dict[str, tuple[float, Array]]:
  """Returns of every commanded joint the sum of squares of its torques over a log's readings, and
  of what no law holds, by cause."""
  data, motion = mujoco.MjData(model), smooth_motion(log)
  ids = [model.joint(name).id for name in log.joints]
  stamps = log.states.stamp
  kept = np.arange(0, len(stamps), max(len(stamps) // _READINGS, 1))
  commands = Told(model, log).mean(stamps[kept], float(model.opt.timestep))
  q, v = np.zeros((len(kept), model.nq)), np.zeros((len(kept), model.nv))
  q[:] = model.qpos0
  q[:, model.jnt_qposadr[ids]] = motion.position[kept]
  v[:, model.jnt_dofadr[ids]] = motion.velocity[kept]
  kinds = ("fluid", "spring", "damper", "actuator", "gravcomp", "passive", "bias")
  forces = {kind: np.zeros_like(v) for kind in kinds}
  rows = np.zeros((len(_ROWS), *v.shape))
  for n, command in enumerate(commands):
    data.qpos[:], data.qvel[:], data.ctrl[:] = q[n], v[n], command
    mujoco.mj_forward(model, data)
    for kind, values in forces.items():
      values[n] = getattr(data, f"qfrc_{kind}")
    rows[:, n] = [_torque(model, data, constraints) for constraints in _ROWS.values()]
  result = {}
  for name in log.commands.joints:
    index = model.joint(name).id
    dof, at = int(model.jnt_dofadr[index]), int(model.jnt_qposadr[index])
    mine = {kind: values[:, dof] for kind, values in forces.items()}
    told = commands[:, actuator_of(model, name)]
    spring, damper, actuator = _held(
      dict(zip(INDEX, declared_parameters(model, name), strict=True)), q[:, at], v[:, dof], told
    )
    lifted = mine["gravcomp"] * bool(model.jnt_actgravcomp[index])
    parts = np.array(
      [
        mine["fluid"],
        mine["spring"] - spring,
        mine["damper"] - damper,
        mine["actuator"] - lifted - actuator,
        *rows[:, :, dof],
      ]
    )
    total = sum(float(np.sum(mine[kind] ** 2)) for kind in ("actuator", "passive", "bias"))
    result[name] = total, np.sum(parts**2, axis=1)
  return result


def _torque(model: mujoco.MjModel, data: mujoco.MjData, kinds: Sequence[int]) -> Array:
  """Returns the torques [nv] of constraints of some kinds."""
  result = np.zeros(model.nv)
  mine = np.isin(data.efc_type, [int(kind) for kind in kinds])
  if mine.any():
    mujoco.mj_mulJacTVec(model, data, result, np.where(mine, data.efc_force, 0.0))
  return result


def _held(p: Mapping[str, float], q: Array, v: Array, command: Array) -> tuple[Array, Array, Array]:
  """Returns the torques [N] of spring, damping and actuator that a joint's parameters say."""
  spring = -p["stiffness"] * (q - p["reference"])
  damper = -p["damping"] * v - p["drag"] * np.abs(v) * v
  asked = p["input"] * command + p["constant"] + p["position"] * q + p["velocity"] * v
  return spring, damper, np.clip(asked, p["lowest"], p["highest"])
