"""What a point mass on a body adds to the joints that carry it, along a log.

With J_k the velocity of the mass per speed of joint k, a unit mass adds to joint j

    inertia |J_j|^2,  gravity's torque -g . J_j,  and J_j . (acceleration by all but j's own)

where the acceleration is the sum of J_k times the joints' accelerations and, of hinges k above l,
the centripetal and Coriolis parts a_k x J_k v_k^2 + 2 a_k x J_l v_k v_l. Shapes: T poses.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

Array = np.ndarray


class Added(NamedTuple):
  """What a joint's surroundings gain per unit of mass [T]."""

  inertia: Array
  here: Array
  across: Array
  bias: Array


class Poses:
  """A model along measured motion, at some of the samples."""

  def __init__(self, model: mujoco.MjModel, addresses: Array, positions: Array):
    """Takes the poses.

    Args:
      model: compiled model.
      addresses: of the joints in qpos [J].
      positions: of the joints [T, J].
    """
    self.model = model
    data = mujoco.MjData(model)
    rows = []
    for position in positions:
      data.qpos[:] = model.qpos0
      data.qpos[addresses] = position
      mujoco.mj_kinematics(model, data)
      rows.append((data.xpos.copy(), data.xmat.copy(), data.xaxis.copy(), data.xanchor.copy()))
    self._place, self._turn, self.axis, self.anchor = (np.array(r) for r in zip(*rows, strict=True))

  def point(self, body: int, place: Array) -> Array:
    """Returns where a place of a body's frame is in the world [T, 3]."""
    turn = self._turn[:, body].reshape(-1, 3, 3)
    return self._place[:, body] + turn @ place

  def hinge(self, joint: int) -> bool:
    """Tells whether a joint is a hinge."""
    return int(self.model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)

  def moved(self, joint: int, point: Array) -> Array:
    """Returns the velocity of a point [T, 3] per speed of a hinge or slide."""
    if not self.hinge(joint):
      return self.axis[:, joint]
    return np.cross(self.axis[:, joint], point - self.anchor[:, joint])


def added(
  poses: Poses,
  carrying: Sequence[int],
  point: Array,
  velocity: Array,
  acceleration: Array,
) -> list[Added]:
  """Returns what a unit mass adds to each of the joints that carry it.

  Args:
    poses: the model along the motion.
    carrying: joints on the way to the mass, the farthest from it first [K].
    point: where the mass is in the world [T, 3].
    velocity: of these joints [T, K].
    acceleration: of these joints [T, K].
  """
  gravity = poses.model.opt.gravity
  moved = [poses.moved(k, point) for k in carrying]
  total = np.zeros_like(point)
  for i, k in enumerate(carrying):
    total += moved[i] * acceleration[:, i, None]
    if poses.hinge(k):
      sums = moved[i] * velocity[:, i, None]
      for nearer in range(i + 1, len(carrying)):
        sums = sums + 2.0 * moved[nearer] * velocity[:, nearer, None]
      total += np.cross(poses.axis[:, k], sums) * velocity[:, i, None]
  rows = []
  for i, k in enumerate(carrying):
    across = np.zeros(len(point))
    if poses.hinge(k):  # a quarter turn further
      across = -np.cross(poses.axis[:, k], moved[i]) @ gravity
    own = moved[i] * acceleration[:, i, None]
    bias = np.einsum("tc,tc->t", moved[i], total - own)
    rows.append(Added(np.sum(moved[i] ** 2, axis=1), -moved[i] @ gravity, across, bias))
  return rows
