"""Pictures at drawn places, for the encoder: places that all differ teach a pose best.

Episodes hold some 40 pictures a second of the same place. Rendering takes no physics: a recorded
posture is put anywhere on the free floor, with head and ball drawn where there is a ball, whose
place then says nothing about the robot's.

Shape letters: N views.
"""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.agents.distill.dataset import BALL_SIZE
from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.dmpo.specs import BALL, JOINTS, POSE_SIZE, POSITION, ROTATION, Layout
from nerf2real.agents.environments.loading import make_environment
from nerf2real.core import files
from nerf2real.core.geometry import rotations
from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.suite.op3 import constants
from nerf2real.suite.sensors.light import draw_light

_PAN, _TILT = (constants.JOINT_NAMES.index(name) for name in ("head_pan", "head_tilt"))
_MAX_PAN = 2.3  # rad, drawn up to it; chosen: as far as a search sweeps
# Chosen: half the picture's width and a little more, so that balls are cut by its sides, too.
_MAX_ASIDE = 0.6  # rad of the ball from where the head looks
_BALL_DISTANCE = (0.2, 2.5)  # m from the robot, drawn evenly in its logarithm; chosen
_BALL_SHARE = 0.75  # of views with the ball ahead of the head; else it is far behind the robot
_ATTEMPTS = 20  # to find the ball a place in the workspace, before it is put behind
_BEHIND = 3.0  # m


def make_views(
  task: Any,
  layout: Layout,
  postures: np.ndarray,
  *,
  rng: np.random.Generator,
  count: int,
  report: Progress = no_progress,
) -> dict[str, np.ndarray]:
  """Renders pictures at drawn places.

  Args:
    task: the environment's, with a camera; its ball is moved, its light changed if it is drawn.
    layout: the environment's.
    postures: recorded privileged observations [M, P], of which height, lean and joints are used.
    rng: draws all that is drawn.
    count: of views, N.
    report: called with the fraction done and a text.

  Returns:
    Arrays as in a data set: `image` [N, H, W, 3], `pose` [N, 3] and, where there is a ball, `ball`.
  """
  assert layout.image_shape is not None
  has_ball = layout.privileged_column(BALL) is not None
  found: dict[str, np.ndarray] = {
    "image": np.empty((count, *layout.image_shape), np.uint8),
    "pose": np.empty((count, POSE_SIZE), np.float32),
  }
  if has_ball:
    found["ball"] = np.empty((count, BALL_SIZE), np.float32)
  places = np.asarray(task.scene.free_space.sample(rng, count))
  for view, place in enumerate(places):
    row = postures[rng.integers(len(postures))].astype(np.float64)
    position, rotation, joints = (
      _part(layout, row, name, size)
      for name, size in ((POSITION, 3), (ROTATION, 9), (JOINTS, len(constants.JOINT_NAMES)))
    )
    turned = _turned_to(rotation.reshape(3, 3), place[2])
    position[:2] = place[:2]
    if has_ball:
      found["ball"][view] = _place_ball(task, place, joints, rng)
    if task.settings.randomisation.light:
      task.robot_camera.set_light(draw_light(rng))
    found["image"][view] = task.picture_of(position=position, rotation=turned, joints=joints)
    found["pose"][view] = place[0], place[1], rotations.yaw_of(turned)
    report((view + 1) / count, "rendering views")
  return found


def kept_views(
  path: Path,
  names: Sequence[str],
  layout: Layout,
  data: Path,
  *,
  seed: int,
  count: int,
  report: Progress = no_progress,
) -> dict[str, np.ndarray]:
  """Returns a run's views: those that its file holds, or new ones, which the file then holds.

  Args:
    path: the file.
    names: of the environments that they are rendered in, the same number in each: where they are
      several reconstructions of one room, an encoder learns what these have in common.
    layout: see `make_views`.
    data: folder of the episodes whose postures are used.
    seed: of what is drawn.
    count: of views in all.
    report: called with the fraction done and a text.
  """
  if not path.exists():
    postures = np.concatenate([_postures(file) for file in sorted(data.glob("[0-9]*.npz"))])
    rng = np.random.default_rng(seed)
    shares = np.array_split(np.arange(count), len(names))
    parts = []
    for number, (name, share) in enumerate(zip(names, shares, strict=True)):
      here = part(report, number / len(names), (number + 1) / len(names))
      with contextlib.closing(make_environment(name, seed=seed)) as environment:
        task = task_of(environment)
        parts.append(make_views(task, layout, postures, rng=rng, count=len(share), report=here))
    made = {name: np.concatenate([views[name] for views in parts]) for name in parts[0]}
    with files.atomic_path(path) as partial:
      np.savez(partial, **made)  # type: ignore[arg-type]
  with np.load(path, allow_pickle=False) as stored:
    return {name: stored[name] for name in stored.files}


def mixed(
  frames: Mapping[str, np.ndarray], views: Mapping[str, np.ndarray], chosen: np.ndarray
) -> dict[str, np.ndarray]:
  """Returns a batch of frames followed by the chosen views; arrays that views lack are left out."""
  return {name: np.concatenate([frames[name], array[chosen]]) for name, array in views.items()}


def _part(layout: Layout, row: np.ndarray, name: str, size: int) -> np.ndarray:
  column = layout.privileged_column(name)
  assert column is not None
  return row[column : column + size].copy()


def _postures(path: Path) -> np.ndarray:
  with np.load(path, allow_pickle=False) as stored:
    return stored["privileged"]


def _turned_to(rotation: np.ndarray, yaw: float) -> np.ndarray:
  """Returns a rotation [3, 3] about the vertical to another heading [rad], its lean as it was."""
  angle = yaw - rotations.yaw_of(rotation)
  cosine, sine = np.cos(angle), np.sin(angle)
  return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ rotation


def _place_ball(
  task: Any, place: np.ndarray, joints: np.ndarray, rng: np.random.Generator
) -> tuple[float, float, float]:
  """Draws head and ball; returns the ball from the robot: ahead, left [m], and the pan [rad]."""
  lower, upper = constants.joint_limits()
  joints[_PAN] = rng.uniform(-_MAX_PAN, _MAX_PAN)
  joints[_TILT] = rng.uniform(lower[_TILT], upper[_TILT])
  for _ in range(_ATTEMPTS if rng.random() < _BALL_SHARE else 0):
    bearing = joints[_PAN] + rng.uniform(-_MAX_ASIDE, _MAX_ASIDE)
    distance = np.exp(rng.uniform(*np.log(_BALL_DISTANCE)))
    if task.workspace.contains(_ahead(place, bearing, distance)):
      break
  else:
    bearing, distance = joints[_PAN] + np.pi, _BEHIND
  task.put_ball(_ahead(place, bearing, distance))
  return float(distance * np.cos(bearing)), float(distance * np.sin(bearing)), float(joints[_PAN])


def _ahead(place: np.ndarray, bearing: float, distance: float) -> np.ndarray:
  """Returns the point [2] [m] at a bearing [rad] and a distance [m] from a place x, y, yaw."""
  angle = place[2] + bearing
  return place[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
