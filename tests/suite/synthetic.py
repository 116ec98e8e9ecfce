"""A made-up room for the tests: boxes as collision parts and a renderer that needs no field."""

import dataclasses
from pathlib import Path

import numpy as np
import trimesh

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.geometry.free_space import FreeSpace

# Boxes (lower, upper) [m]: walls of a 6 x 5 m room and furniture.
BOXES = (
  ((-3.1, -2.6, 0.0), (-3.0, 2.6, 2.4)),
  ((3.0, -2.6, 0.0), (3.1, 2.6, 2.4)),
  ((-3.1, -2.6, 0.0), (3.1, -2.5, 2.4)),
  ((-3.1, 2.5, 0.0), (3.1, 2.6, 2.4)),
  ((2.0, 1.4, 0.0), (2.8, 2.2, 0.5)),
  ((2.2, -2.2, 0.0), (2.8, -1.6, 0.8)),
  ((2.0, -0.5, 0.0), (2.4, 0.5, 0.03)),  # low enough to be touched by toes alone
)
FREE = ((-2.6, -2.1), (1.6, 2.1))  # lower and upper corner of the free floor


class FreeFloor(FreeSpace):
  """A rectangle of free floor."""

  def sample(self, rng, count):
    return np.column_stack([rng.uniform(*FREE, (count, 2)), rng.uniform(-np.pi, np.pi, count)])

  def is_reachable(self, points):
    xy = np.asarray(points)
    return ((xy >= FREE[0]) & (xy <= FREE[1])).all(axis=-1)


@dataclasses.dataclass
class Room:
  """What a task needs of a bundle."""

  collision_parts: list
  extent: tuple = (np.array([-3.1, -2.6, 0.0]), np.array([3.1, 2.6, 2.4]))
  goals: np.ndarray = dataclasses.field(
    default_factory=lambda: np.array([[1.0, 1.0], [-2.0, 1.5], [0.5, -1.8]])
  )
  world_from_unit: Similarity = dataclasses.field(
    default_factory=lambda: Similarity(3.2, np.eye(3), np.array([0.1, -0.2, 1.3]))
  )
  free_space: FreeFloor = dataclasses.field(default_factory=FreeFloor)
  name: str = "test room"


def make_room(folder: Path) -> Room:
  """Writes the boxes as Wavefront files into a folder and returns the room."""
  parts = []
  for index, (lower, upper) in enumerate(BOXES):
    path = Path(folder) / f"part_{index:03d}.obj"
    lower, upper = np.array(lower), np.array(upper)
    mesh = trimesh.creation.box(upper - lower)
    mesh.apply_translation((lower + upper) / 2)
    mesh.export(path)
    parts.append(path)
  return Room(parts)


class FlatRenderer:
  """Renders one colour at one depth, with the interface of `Renderer`."""

  def __init__(self, color=(40, 80, 120), depth=np.inf):
    self.color, self.depth = color, depth  # depth in the unit frame
    self.poses = []

  def render(self, camera, unit_from_camera):
    self.poses.append(np.array(unit_from_camera))
    shape = (camera.height, camera.width)
    return (
      np.broadcast_to(np.array(self.color, np.uint8), (*shape, 3)),
      np.full(shape, self.depth, np.float32),
    )
