"""An empty floor in place of a scene: to try a gait where nothing stands in the way."""

import dataclasses

import numpy as np

from nerf2real.scenes.geometry.free_space import FreeSpace

_HALF_SIZE = 10.0  # m


class _Free(FreeSpace):
  """All of the floor is free."""

  def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
    """Draws x, y, yaw [count, 3] near the middle."""
    low, high = (-1, -1, -np.pi), (1, 1, np.pi)
    return rng.uniform(low, high, (count, 3))

  def is_reachable(self, points: np.ndarray) -> np.ndarray:
    """Returns whether points [..., 2] lie on the floor."""
    return (np.abs(np.asarray(points)) < _HALF_SIZE).all(axis=-1)


@dataclasses.dataclass
class EmptyFloor:
  """What a task needs of a scene, with nothing in it."""

  goals: np.ndarray = dataclasses.field(default_factory=lambda: np.array([[5.0, 0.0]]))
  collision_parts: tuple = ()
  extent: tuple = (np.full(2, -_HALF_SIZE), np.full(2, _HALF_SIZE))
  free_space: _Free = dataclasses.field(default_factory=_Free)
  world_from_unit: None = None
  name: str = "empty floor"
