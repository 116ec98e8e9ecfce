"""Holds the places of a film together by how a hand moves.

Parts of a film may hang together by a few dozen matches: of a plain wall, of a picture that is
blurred. What the pictures see leaves the size of such a part next to free, and an adjustment ends
at whatever size it began at; at the part's ends the camera then leaps. A hand does not: its
velocity changes little from one keyframe to the next. As a prior of an adjustment that settles what
pictures leave free, and what they know it does not move.

Source of the prior: Anderson and Barfoot 2015, Full STEAM ahead (white noise on acceleration).
Shapes: N pictures in the film's order, O observations, P points.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.capture.posed.colmap_model import camera_of
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.elimination import Sights, eliminate
from nerf2real.scenes.poses.mapping import registered
from nerf2real.scenes.poses.matching.features import quiet

_MEDIAN = 1.538  # of the length of three normal numbers of deviation 1 (Maxwell)
# How many times stiffer than it is a hand is taken to be, one round after the other: what a part
# that has come apart is held by must first give way. Chosen on maps of one film, of which one leapt
# again after fewer stiff rounds.
GIVING_WAY = (30.0, 30.0, 15.0, 6.0, 3.0, 1.0)
AS_IT_IS = (1.0,)  # where nothing has come apart
_STEPS = 8  # of Gauss and Newton in a round, chosen
_SETTLED = 1e-3  # of the cost: less is no step worth another
_DAMPING = 1e-9  # of the curvature, at least
_MOST_DAMPING = 1e3
_RIGID = 1e8  # curvature against a move, a turn and a change of size of all


def accelerations(times: np.ndarray) -> np.ndarray:
  """Returns the matrix [N - 2, N] from places to changes of velocity, each over the root of the
  time in which it comes about: of a hand all have one deviation.

  Args:
    times: When each picture was taken [s] [N]; they strictly grow.
  """
  steps, rows = np.diff(times), np.arange(len(times) - 2)
  found = np.zeros((len(rows), len(times)))
  found[rows, rows] = 1 / steps[:-1]
  found[rows, rows + 1] = -1 / steps[:-1] - 1 / steps[1:]
  found[rows, rows + 2] = 1 / steps[1:]
  shares: np.ndarray = found / np.sqrt((times[2:] - times[:-2]) / 2)[:, None]
  return shares


def roughness(centers: np.ndarray, times: np.ndarray) -> tuple[float, float]:
  """Deviation of a hand's acceleration, by its median, and the most of it in deviations.

  Args:
    centers: Positions [N, 3].
    times: When [s] [N]; they strictly grow. Both are 0 for fewer than three.
  """
  if len(times) < 3:
    return 0.0, 0.0
  sizes = np.linalg.norm(accelerations(times) @ centers, axis=1)
  usual = float(np.median(sizes)) / _MEDIAN
  return usual, float(sizes.max() / max(usual, 1e-12))


def path(
  model: pycolmap.Reconstruction, times: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
  """Positions [N, 3] of a film's pictures, and when they were taken [s] [N]."""
  images = registered(model)
  centers = np.array([image.projection_center() for image in images]).reshape(-1, 3)
  return centers, np.array([times[image.name] for image in images])


class _State(NamedTuple):
  """Poses and points of a model."""

  rotations: np.ndarray  # camera from world [N, 3, 3]
  moves: np.ndarray  # [N, 3]
  points: np.ndarray  # [P, 3]

  @property
  def centers(self) -> np.ndarray:
    """Positions of the cameras [N, 3]."""
    return -np.einsum("nji,nj->ni", self.rotations, self.moves)


class _Film:
  """A model's observations, and what a hand's motion says of its places."""

  def __init__(self, model: pycolmap.Reconstruction, times: np.ndarray, deviation: float):
    self._images = registered(model)
    self._camera = camera_of(model)
    seen = [[place for place in i.points2D if place.has_point3D()] for i in self._images]
    ids = np.array([place.point3D_id for places in seen for place in places])
    self._ids, self._point = np.unique(ids, return_inverse=True)
    self._pixels = [np.array([p.xy for p in places]).reshape(-1, 2) for places in seen]
    self._ends = np.cumsum([0] + [len(places) for places in seen])
    self._hand = sparse.kron(accelerations(times) / deviation, np.eye(3), format="csr")
    poses = [image.cam_from_world() for image in self._images]
    self.state = _State(
      np.array([pose.rotation.matrix() for pose in poses]),
      np.array([pose.translation for pose in poses]),
      np.array([model.points3D[key].xyz for key in self._ids]),
    )

  def _local(self, state: _State, picture: int) -> np.ndarray:
    rows = self._point[self._ends[picture] : self._ends[picture + 1]]
    local: np.ndarray = state.points[rows] @ state.rotations[picture].T + state.moves[picture]
    return local

  def cost(self, state: _State) -> float:
    """Twice what is minimised: of the observations by soft L1, and of the hand's motion."""
    total = float(np.square(self._hand @ state.centers.ravel()).sum())
    for picture, pixels in enumerate(self._pixels):
      local = self._local(state, picture)
      squares = np.square(self._camera.project(local) - pixels).sum(-1)
      squares = np.where(local[:, 2] > 0, squares, mapping.MAX_ERROR**2 * 1e4)
      total += float((2 * (np.sqrt(1 + squares) - 1)).sum())
    return total

  def step(self, damping: float) -> _State:
    """The state after a damped Gauss-Newton step."""
    state, still = self.state, np.zeros(3)
    by_pose, by_point, errors = [], [], []
    for picture, pixels in enumerate(self._pixels):
      local = self._local(state, picture)
      if not len(local):
        continue
      _, slope = cv2.projectPoints(
        local, still, still, self._camera.opencv_matrix, self._camera.distortion
      )
      slope = slope.reshape(len(local), 2, -1)
      error = self._camera.project(local) - pixels
      weight = (1.0 + np.square(error).sum(-1)) ** -0.25 * (local[:, 2] > 0)  # soft L1's root
      by_pose.append(weight[:, None, None] * slope[..., :6])
      by_point.append(by_pose[-1][..., 3:] @ state.rotations[picture])
      errors.append(weight[:, None] * error)
    sights = Sights(
      picture=np.repeat(np.arange(len(self._pixels)), np.diff(self._ends)),
      point=self._point,
      by_pose=np.concatenate(by_pose),
      by_point=np.concatenate(by_point),
      shared=np.zeros((len(self._point), 2, 0)),
      errors=np.concatenate(errors),
    )
    reduced = eliminate(sights, len(self._pixels), damping=_DAMPING + damping)
    centers = state.centers
    by_move = np.concatenate([np.zeros_like(state.rotations), -state.rotations.swapaxes(1, 2)], -1)
    moved = sparse.block_diag(by_move, format="csr")  # the centers, by the unknowns
    hand, held = self._hand @ moved, (moved.T @ _alike(centers).T).T
    curvature = reduced.curvature + (hand.T @ hand).toarray() + _RIGID * held.T @ held
    gradient = reduced.gradient + hand.T @ (self._hand @ centers.ravel())
    found = np.linalg.solve(curvature, -gradient)
    change = found.reshape(-1, 6)
    turns = Rotation.from_rotvec(change[:, :3]).as_matrix()
    return _State(
      turns @ state.rotations,
      np.einsum("nij,nj->ni", turns, state.moves) + change[:, 3:],
      state.points + reduced.points(found),
    )

  def write(self, model: pycolmap.Reconstruction) -> None:
    """Moves the model's poses and points, in place."""
    for image, rotation, move in zip(
      self._images, self.state.rotations, self.state.moves, strict=True
    ):
      pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), move)
      model.frames[image.frame_id].set_cam_from_world(image.camera_id, pose)
    for key, position in zip(self._ids, self.state.points, strict=True):
      model.points3D[key].xyz = position


def _alike(centers: np.ndarray) -> np.ndarray:
  """Directions [7, 3 N], of length 1, in which all places move, turn and grow as one."""
  about = centers - centers.mean(axis=0)
  moves = [np.tile(axis, len(centers)) for axis in np.eye(3)]
  turns = [np.cross(axis, about).ravel() for axis in np.eye(3)]
  found = np.array([*moves, *turns, about.ravel()])
  unit: np.ndarray = found / np.linalg.norm(found, axis=1)[:, None]
  return unit


def _adjust(model: pycolmap.Reconstruction, times: np.ndarray, deviation: float) -> None:
  """Adjusts poses and points, in place, by the pictures and by a hand's motion."""
  film = _Film(model, times, deviation)
  cost, damping = film.cost(film.state), 0.0
  for _ in range(_STEPS):
    state = film.step(damping)
    new = film.cost(state)
    while not new < cost and damping < _MOST_DAMPING:
      damping = max(10 * damping, 1e-6)
      state = film.step(damping)
      new = film.cost(state)
    if not new < cost:
      break
    film.state, gained, cost, damping = state, cost - new, new, damping / 10
    if gained < _SETTLED * cost:
      break
  film.write(model)


def hold(
  model: pycolmap.Reconstruction,
  database: Path,
  times: Mapping[str, float],
  *,
  rounds: Sequence[float] = GIVING_WAY,
  report: Progress = no_progress,
) -> pycolmap.Reconstruction:
  """Returns a film's model whose places are held by what its pictures see and by a hand's motion.

  Args:
    model: Poses and points; its pictures' names are in the film's order.
    database: Their features and verified matches.
    times: When each picture was taken [s].
    rounds: How many times stiffer than it is a hand is taken to be in each.
    report: Called with the fraction done and a text.
  """
  centers, taken = path(model, times)
  if len(taken) < 4 or np.diff(taken).min() <= 0:
    return model
  usual, _ = roughness(centers, taken)
  if usual <= 0:  # half of the film stands still, which says nothing of a hand
    return model
  model = pycolmap.Reconstruction(model)
  with quiet(), pycolmap.Database.open(str(database)) as opened:
    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches = pycolmap.IncrementalPipelineOptions().min_num_matches
    options.load_all_images = True  # of those of the model, matched or not
    options.image_names = {image.name for image in model.images.values()}
    graph = pycolmap.DatabaseCache.create(opened, options).correspondence_graph
  for done, stiff in enumerate(rounds):
    report(done / len(rounds), "holding the places by a hand's motion")
    _adjust(model, taken, usual / stiff)
    _see_again(model, graph, mapping.MAX_ERROR * stiff**0.5)
  return model


def _see_again(
  model: pycolmap.Reconstruction, graph: pycolmap.CorrespondenceGraph, limit: float
) -> None:
  """Drops what a model's pictures do not see from their places to a limit [pixel], and finds what
  they do."""
  options = pycolmap.IncrementalTriangulatorOptions()
  options.ignore_two_view_tracks = False
  with quiet():
    observations = pycolmap.ObservationManager(model, graph)
    observations.filter_all_points3D(limit, mapping.MIN_ANGLE)
    triangulator = pycolmap.IncrementalTriangulator(graph, model, observations)
    triangulator.retriangulate(options)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
  mapping.drop_points_in_cameras(model)
