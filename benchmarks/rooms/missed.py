"""The built-in room's true surface that no convex part is near, and why.

  python benchmarks/rooms/missed.py --scene out/room

Of a scene that `launch/make_scene.py --capture builtin` made. A point of the true surface may be
missed because no keyframe shows it, because the field's depth is wrong where they do, or, with the
right depth, by what makes parts of it. Visible is what no true solid hides, in the picture and not
seen at a grazing angle.
"""

import collections
import dataclasses
from pathlib import Path

import mujoco
import numpy as np
from scipy import spatial

from benchmarks import harness
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.serialization import from_plain
from nerf2real.scenes.alignment.world_frame import Alignment
from nerf2real.scenes.builtin import furniture, ground_truth, room
from nerf2real.scenes.bundle import STAGES, Bundle
from nerf2real.scenes.geometry import collision
from nerf2real.scenes.poses import localisation
from nerf2real.scenes.quality.collision_error import sample_parts

_TOLERANCE = 0.05  # m, as the figures of contact geometry count
_STEEPEST = 0.1  # least cosine of incidence of a picture that shows a point
_NEAR = 0.1  # m before a camera where nothing is looked at
_FIELD_OF_VIEW = 1.5  # tangent; farther out a lens polynomial may fold back into the picture
_HIDDEN = 0.01  # m that a true solid may be hit before a point that is visible
_POINTS = 60_000  # on the true surface
_CELL = 0.01  # m: of the points in a cell one counts
_CONTACT_GROUP = 3  # of the room's geoms


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Which scene."""

  scene: Path
  """Folder of the bundle, with its stages."""


class Truth:
  """The room's true surface, as visible from a camera."""

  def __init__(self, lower: np.ndarray, upper: np.ndarray, floor_threshold: float):
    points, normals = room.builtin().surface(_POINTS)
    inside = ((points > lower) & (points < upper)).all(-1) & (points[:, 2] > floor_threshold)
    _, first = np.unique(
      np.floor(points[inside] / _CELL).astype(np.int64), axis=0, return_index=True
    )
    self.points, self.normals = points[inside][first], normals[inside][first]
    things = room.builtin().solids
    nearest = np.argmin([np.abs(thing.signed_distance(self.points)) for thing in things], axis=0)
    self.owners = np.array([things[k].name.split("_")[0] for k in nearest])
    self._model = room.build_room(looks=False).compile()
    self._data = mujoco.MjData(self._model)
    mujoco.mj_forward(self._model, self._data)

  def visible(self, camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which points [K] a picture shows, and where [K, 2] [pixel]."""
    ways = self.points - pose[:3, 3]
    distance = np.linalg.norm(ways, axis=-1)
    local = ways @ pose[:3, :3]
    seen = (-(ways * self.normals).sum(-1) > _STEEPEST * distance) & (local[:, 2] > _NEAR)
    seen &= (np.abs(local[:, :2]) < _FIELD_OF_VIEW * local[:, 2:]).all(-1)
    index = np.flatnonzero(seen)
    pixels = camera.project(local[index])
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
    index, pixels = index[inside], pixels[inside]
    if not len(index):
      return index, pixels
    groups = (np.arange(mujoco.mjNGROUP) == _CONTACT_GROUP).astype(np.uint8)
    geom, reach = np.empty(len(index), np.int32), np.empty(len(index))
    toward = (ways[index] / distance[index, None]).ravel()
    mujoco.mj_multiRay(
      self._model, self._data, pose[:3, 3], toward, groups, True, -1, geom, reach, None,
      len(index), 1e3,
    )  # fmt: skip
    free = reach > distance[index] - _HIDDEN
    return index[free], pixels[free]


def main(settings: Settings) -> None:
  """Sorts the missed points by their reason and their object."""
  bundle = Bundle.load(settings.scene)
  stages = bundle.folder / STAGES
  place = from_plain(bundle.scene["alignment"], Alignment)
  room_from_world = from_plain(bundle.figures["room_from_world"], Similarity)
  found = localisation.load(stages / "poses" / "sfm")
  depth = np.load(stages / "corrected" / "depth.npy")
  camera = found.camera.resized(depth.shape[2], depth.shape[1])
  poses = (room_from_world @ place.world_from_unit).apply_pose(found.world_from_camera)
  half = np.array(furniture.ROOM_SIZE[:2]) / 2 + 0.1
  top = collision.CollisionSettings().top
  truth = Truth(np.array([*-half, 0.0]), np.array([*half, top]), place.floor_threshold)
  parts = ground_truth.moved(collision.read_parts(bundle.folder / "collision"), room_from_world)
  to_parts = spatial.cKDTree(sample_parts(parts)).query(truth.points)[0]
  missed = np.minimum(to_parts, truth.points[:, 2]) > _TOLERANCE
  shown, right = (np.zeros(len(missed), np.int64) for _ in range(2))
  for pose, picture in zip(poses, depth, strict=True):
    index, pixels = truth.visible(camera, pose)
    column, row = pixels.astype(int).T
    ways = truth.points[index] - pose[:3, 3]
    along = ways @ pose[:3, 2]
    error = (picture[row, column] / along - 1) * np.linalg.norm(ways, axis=-1)
    shown[index] += 1
    right[index] += np.abs(error) < _TOLERANCE
  seen, deep = shown > 0, right > 0.5 * shown
  reasons = {"unseen": ~seen, "wrong depth": seen & ~deep, "geometry": seen & deep}
  figures: dict[str, dict[str, harness.Value]] = {
    "surface": {
      "near_parts": float((~missed).mean()),
      "seen": float(seen.mean()),
      "seen_near_parts": float((~missed)[seen].mean()),
    },
    "missed": {name: float(those[missed].mean()) for name, those in reasons.items()},
  }
  for name, _ in collections.Counter(truth.owners[missed]).most_common(6):
    own = missed & (truth.owners == name)
    figures[f"missed {name}"] = {
      reason: float((own & those).sum() / missed.sum()) for reason, those in reasons.items()
    }
  harness.finish("missed", figures, settings)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
