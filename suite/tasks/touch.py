"""What the robot touches with anything but its feet: the room, or the floor."""

import mujoco
import numpy as np

from nerf2real.suite.op3 import op3

_SCENE, _FLOOR = 1, 2  # bits


class Touch:
  """Records what parts of the robot other than the feet have touched in an episode."""

  def __init__(self, model: mujoco.MjModel, *, root: int, feet: list[int]):
    """Prepares a table of all pairs of geoms.

    Args:
      model: The compiled model.
      root: Body at the root of the robot's tree.
      feet: Bodies that may touch anything.
    """
    robot = (model.body_rootid[model.geom_bodyid] == root) & ~np.isin(model.geom_bodyid, feet)
    static = model.body_weldid[model.geom_bodyid] == 0
    bits = np.where(model.geom_group == op3.FLOOR_GROUP, _FLOOR, _SCENE)
    one_way = np.outer(robot, static * bits)
    self._table = (one_way | one_way.T).astype(np.uint8)  # [geoms, geoms]
    self._touched = 0

  @property
  def scene(self) -> bool:
    """Whether the room has been touched."""
    return bool(self._touched & _SCENE)

  @property
  def floor(self) -> bool:
    """Whether the floor has been touched."""
    return bool(self._touched & _FLOOR)

  def reset(self) -> None:
    """Clears the record for a new episode."""
    self._touched = 0

  def note(self, data: mujoco.MjData) -> None:
    """Adds the present contacts."""
    if data.ncon:
      self._touched |= self._found(data)

  def now(self, data: mujoco.MjData) -> bool:
    """Returns whether room or floor are touched by the present contacts, without noting it."""
    return bool(data.ncon and self._found(data))

  def _found(self, data: mujoco.MjData) -> int:
    pairs = data.contact.geom
    return int(np.bitwise_or.reduce(self._table[pairs[:, 0], pairs[:, 1]]))


def collide(model: mujoco.MjModel, data: mujoco.MjData) -> None:
  """Finds the contacts of the present qpos."""
  mujoco.mj_kinematics(model, data)
  mujoco.mj_comPos(model, data)
  mujoco.mj_collision(model, data)
