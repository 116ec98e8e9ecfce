"""What of a declared model the simulation of one joint holds; joints with more are not judged.

A feature that is left out silently makes a healthy machine look as if it had an effect. A joint
with one, as the finger of a gripper that is tied to another, stands in the way of no other joint:
it moves as it was told to and is not judged.
"""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model import chains
from nerf2real.sysid.model.drive import actuator_of, actuators_of
from nerf2real.sysid.model.limits.unheld import unheld

_CHAIN = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


def left_out(model: mujoco.MjModel, logs: Sequence[Log]) -> dict[str, str]:
  """Returns which joints of logs have what identification leaves out, and what that is: a feature
  of the model, or torques under these logs (`unheld`).

  Args:
    model: declared; of a machine on a stand.
    logs: to identify from. Joints that they command are judged by the whole, those that they
      measure alone by the model's features.

  Raises:
    ValueError: all joints that are commanded have such.
  """
  commanded = list(dict.fromkeys(name for log in logs for name in log.commands.joints))
  driven = [name for log in logs for name in log.joints if actuators_of(model, name)]
  features = {name: _beyond(model, name) for name in (*commanded, *driven)}
  found = {name: what for name, what in features.items() if what is not None}
  found = unheld(model, logs) | found
  if set(commanded) <= set(found):
    name = commanded[0]
    raise ValueError(
      f"The model has {found[name]} at joint {name!r}, which identification leaves out: expected a "
      "hinge or slide with one motor or servo without a state, that touches nothing; give a model "
      "and logs without it."
    )
  return found


def _beyond(model: mujoco.MjModel, joint: str) -> str | None:
  """Returns what a joint has that the simulation of it leaves out; None without any."""
  u, index = actuator_of(model, joint), model.joint(joint).id
  fixed, affine = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
  if int(model.actuator_dyntype[u]) != int(mujoco.mjtDyn.mjDYN_NONE):
    return "an actuator with a time constant or another state"
  if model.actuator_delay[u] > 0.0:
    return "an actuator with a delay"
  if model.actuator_armature[u] or model.actuator_damping[u]:
    return "an actuator with armature or damping of its own"
  if int(model.actuator_gaintype[u]) != fixed or int(model.actuator_biastype[u]) > affine:
    return "an actuator that is neither a motor nor an affine servo"
  lifted = np.any(model.body_gravcomp[chains.carried(model, int(model.jnt_bodyid[index]))])
  if lifted and model.jnt_actgravcomp[index] and model.jnt_actfrclimited[index]:
    return "gravity compensation within a range of force (actuatorgravcomp with actuatorfrcrange)"
  wraps = (model.wrap_type == int(mujoco.mjtWrap.mjWRAP_JOINT)) & (model.wrap_objid == index)
  if np.any(wraps):
    return "a tendon"
  if any(_ties(model, int(e), index) for e in np.flatnonzero(model.eq_active0)):
    return "an equality constraint"
  return None


def _ties(model: mujoco.MjModel, equality: int, joint: int) -> bool:
  """Tells whether an equality constraint is of a joint, or closes a chain that it is in."""
  kind, ends = int(model.eq_type[equality]), (model.eq_obj1id[equality], model.eq_obj2id[equality])
  if kind == int(mujoco.mjtEq.mjEQ_JOINT):
    return joint in ends
  bodies = int(model.eq_objtype[equality]) == int(mujoco.mjtObj.mjOBJ_BODY)
  held = ends if bodies else model.site_bodyid[list(ends)]
  carried = chains.carried(model, int(model.jnt_bodyid[joint]))
  return kind in _CHAIN and sum(int(end) in carried for end in held) == 1


def without_disabled(model: mujoco.MjModel) -> mujoco.MjModel:
  """Returns a compiled model, changed, without the gravity and dry friction that its flags switch
  off: its constants are read where its flags are not."""
  flags = int(model.opt.disableflags)
  if flags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY):
    model.opt.gravity[:] = 0.0
  if flags & int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS):
    model.dof_frictionloss[:] = 0.0
  return model


def on_a_stand(path: Path, model: mujoco.MjModel) -> mujoco.MjModel:
  """Returns a model whose driven machine cannot fall: a free base is held where it is declared.

  Args:
    path: of the model.
    model: the same, compiled; returned itself where no driven machine is free.

  Raises:
    ValueError: a driven machine is free and without weight, which nothing holds.
  """
  driven = chains.driven(model)
  free = int(mujoco.mjtJoint.mjJNT_FREE)
  loose = [j for j in np.flatnonzero(model.jnt_type == free) if model.jnt_bodyid[j] in driven]
  if not loose:
    return model
  if not np.any(model.opt.gravity):
    raise ValueError(
      "The model's base is free and without weight, so that nothing holds it, expected a machine "
      "on a stand: give a model whose base is fixed, and logs of a machine that is."
    )
  spec = mujoco.MjSpec.from_file(str(path))
  spec.compile()  # gives its bodies their numbers
  bases = {int(model.jnt_bodyid[j]) for j in loose}
  for joint in list(spec.joints):
    if joint.type == mujoco.mjtJoint.mjJNT_FREE and joint.parent.id in bases:
      spec.delete(joint)
  for key in list(spec.keys):  # their states have the base's, too
    spec.delete(key)
  return without_disabled(spec.compile())
