"""What hangs on what in a model: the joints that carry a body, the bodies that a body carries."""

import mujoco
import numpy as np

SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
"""Joints of one degree of freedom."""


def driven(model: mujoco.MjModel) -> set[int]:
  """Returns the root bodies of what actuators on joints move."""
  on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
  bodies = model.jnt_bodyid[model.actuator_trnid[on_joint, 0]]
  return set(map(int, model.body_rootid[bodies]))


def carrying(model: mujoco.MjModel, body: int) -> list[int]:
  """Returns the hinges and slides on the way to a body, the farthest from it first."""
  result: list[int] = []
  while body > 0:
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    result = [k for k in range(first, first + count) if model.jnt_type[k] in SINGLE] + result
    body = int(model.body_parentid[body])
  return result


def carried(model: mujoco.MjModel, body: int) -> np.ndarray:
  """Returns a body and all that it carries [bodies]."""
  below = np.zeros(model.nbody, bool)
  below[body] = True
  for k in range(body + 1, model.nbody):
    below[k] |= below[model.body_parentid[k]]
  return np.flatnonzero(below)


def ancestors(model: mujoco.MjModel, body: str) -> list[str]:
  """Returns the joints that carry a body, the nearest first; none where no body has that name."""
  index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
  return [model.joint(k).name for k in reversed(carrying(model, index))]


def along(model: mujoco.MjModel, joint: str) -> list[str]:
  """Returns the joints that carry a joint, itself, and those that it carries, from the root on."""
  index, body = model.joint(joint).id, model.jnt_bodyid
  near = [
    k
    for k in range(model.njnt)
    if index in carrying(model, body[k]) or k in carrying(model, body[index])
  ]
  return [model.joint(k).name for k in near]
