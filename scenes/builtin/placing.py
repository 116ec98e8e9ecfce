"""Places solids in the built-in room. World frame: z up, floor z = 0, metres."""

from typing import Any

import numpy as np

from nerf2real.core.geometry.rotations import yaw_matrix
from nerf2real.scenes.builtin.solids import Solid

ROOM_SIZE = (5.0, 4.0, 2.5)  # x in [-2.5, 2.5], y in [-2, 2], z in [0, 2.5]


def facing(normal: tuple[float, float, float]) -> np.ndarray:
  """Returns axes of an upright panel: local z is the horizontal normal, y is up, x to the right."""
  z = np.asarray(normal, float)
  up = np.array([0.0, 0.0, 1.0])
  return np.stack([np.cross(up, z), up, z], axis=-1)


class Group:
  """Collects the solids of one piece of furniture, placed in the room by a position and a yaw."""

  def __init__(
    self, name: str, position: tuple[float, ...] | np.ndarray = (0.0, 0.0, 0.0), angle: float = 0.0
  ):
    self.solids: list[Solid] = []
    self._name, self._position, self._rotation = (
      name,
      np.asarray(position, float),
      yaw_matrix(angle),
    )

  def add(self, kind: str, size, position, material: str, *, rotation=None, **look: Any) -> None:
    """Adds a solid given in the group's frame."""
    rotation = np.eye(3) if rotation is None else rotation
    count = len(self.solids)
    look.setdefault("offset", (0.381 * count % 1, 0.617 * count % 1))
    self.solids.append(
      Solid(
        name=f"{self._name}_{count}",
        kind=kind,
        size=(float(size[0]), float(size[1]), float(size[2])),
        position=self._position + self._rotation @ np.asarray(position, float),
        rotation=self._rotation @ rotation,
        material=material,
        **look,
      )
    )
