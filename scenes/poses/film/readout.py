"""Estimates a rolling shutter's readout time and takes it out of observations.

With the motion between neighbouring keyframes known, an observation moves to where a shutter that
reads all lines at once, in the middle of the readout, would have seen it; the readout time is the
one that poses, points and lens fit best together with.
Source of the model: Hedborg et al. 2012, Rolling shutter bundle adjustment, with the motion of
neighbouring keyframes in place of a pose a frame. Shapes: N pictures, O observations.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.capture.posed.colmap_model import camera_of
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.elimination import Sights, eliminate
from nerf2real.scenes.poses.film.shutter import Shutter, instants
from nerf2real.scenes.poses.mapping import registered

_PRECISION = 0.0005  # s of the readout, chosen: a twentieth of a pixel in a fast pan
_ROUNDS = 6  # of the readout and adjustments at most, chosen: three or four suffice
_SMALL = 0.001  # s: unit of the readout in its derivatives
_DAMPING = 1e-9  # of the curvature, chosen: holds the place, the turn and the size of all
_FARTHEST_NEIGHBOURS = 2.0  # s between two keyframes that say how the one between them moved

TOO_FAR_APART = (
  "Rolling shutter: all keyframes lie too far apart in time to tell how the phone moved "
  f"while a frame was read (the two around one by {_FARTHEST_NEIGHBOURS:g} s or more), so that it "
  "stays in. Give more --keyframes, or film for less long."
)

_FOCAL, _PRINCIPAL, _DISTORTION = (6, 7), (8, 9), (10, 11, 12, 13)
"""Columns of `cv2.projectPoints`'s Jacobian; a turn and a move of all points come before."""


class _Sight(NamedTuple):
  """What a picture saw, as measured."""

  rows: np.ndarray  # indices into its points2D [O]
  pixels: np.ndarray  # [O, 2]


def _measured(model: pycolmap.Reconstruction) -> list[_Sight]:
  sights = []
  for image in registered(model):
    places = image.points2D
    rows = np.array([k for k, place in enumerate(places) if place.has_point3D()], np.int64)
    sights.append(_Sight(rows, np.array([places[int(k)].xy for k in rows]).reshape(-1, 2)))
  return sights


def _local_points(
  model: pycolmap.Reconstruction, image: pycolmap.Image, rows: np.ndarray
) -> np.ndarray:
  """Points [O, 3] that a picture's observations show, in its camera's frame."""
  places, pose = image.points2D, image.cam_from_world()
  world = np.array([model.points3D[places[int(k)].point3D_id].xyz for k in rows]).reshape(-1, 3)
  local: np.ndarray = world @ pose.rotation.matrix().T + pose.translation
  return local


def frame_period(times: Mapping[str, float]) -> float | None:
  """Mean time from one of a film's frames to the next [s]; None where times do not strictly grow.

  Args:
    times: When each keyframe was taken [s]; names end in the frames' numbers.
  """
  frames = sorted((int(Path(name).stem.split("_")[-1]), time) for name, time in times.items())
  numbers, when = np.array(frames).reshape(-1, 2).T
  if len(frames) < 2 or np.diff(when).min() <= 0:
    return None
  return float((when[-1] - when[0]) / (numbers[-1] - numbers[0]))


def tells_motion(model: pycolmap.Reconstruction, times: Mapping[str, float]) -> bool:
  """Tells whether any keyframe has neighbours near enough in time to say how it moved.

  Where few keyframes of a film are kept none may have.

  Args:
    model: Localised pictures.
    times: When each was taken [s]; they strictly grow.
  """
  lasted = _between_neighbours(np.array([times[image.name] for image in registered(model)]))[2]
  return bool((lasted < _FARTHEST_NEIGHBOURS).any())


def _between_neighbours(when: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Rows of the keyframes before and after each, itself at an end, and the time between [s] [N]."""
  before = np.maximum(np.arange(len(when)) - 1, 0)
  after = np.minimum(np.arange(len(when)) + 1, len(when) - 1)
  return before, after, when[after] - when[before]


def motion(model: pycolmap.Reconstruction, times: Mapping[str, float], readout: float) -> Shutter:
  """Derives the motion during the readout from the poses of neighbouring keyframes.

  Args:
    model: Localised pictures.
    times: When each was taken [s]; they strictly grow.
    readout: From the first line to the last [s].
  """
  images = registered(model)
  when = np.array([times[image.name] for image in images])
  poses = [image.cam_from_world().inverse() for image in images]
  rotations = Rotation.from_matrix([pose.rotation.matrix() for pose in poses])
  centres = np.array([pose.translation for pose in poses])
  before, after, lasted = _between_neighbours(when)
  share = np.where(lasted < _FARTHEST_NEIGHBOURS, readout / lasted, 0.0)[:, None]
  depths = [
    np.median(_local_points(model, image, sight.rows)[:, 2])
    for image, sight in zip(images, _measured(model), strict=True)
  ]
  return Shutter(
    readout=readout,
    rotations=share * (rotations[before].inv() * rotations[after]).as_rotvec(),
    translations=share * rotations.inv().apply(centres[after] - centres[before]),
    depths=np.array(depths),
  )


def _move_observations(
  model: pycolmap.Reconstruction, measured: list[_Sight], moved: Shutter
) -> None:
  """Moves the observations of a model, in place, to the middle of the readout."""
  camera = camera_of(model)
  for index, (image, sight) in enumerate(zip(registered(model), measured, strict=True)):
    points = _local_points(model, image, sight.rows)
    shift = moved.project(points, instants(sight.pixels, camera), index, camera)
    shift -= camera.project(points)
    for k, pixel in zip(sight.rows, sight.pixels - shift, strict=True):
      image.points2D[int(k)].xy = pixel


def _change(
  model: pycolmap.Reconstruction,
  measured: list[_Sight],
  times: Mapping[str, float],
  lens: list[int],
  readout: float,
  longest: float,
) -> float:
  """Returns by how much the readout changes in a Gauss-Newton step of poses, points, lens and it.

  Adjustments end before they have settled, by more than the costs of two readouts differ: what they
  would do yet is a part of the step. Errors are weighed as in an adjustment, by pixels; a readout
  that few keyframes tell is held at none by a prior as wide as the longest.

  Args:
    model: With its observations as they are at the present readout.
    measured: Its observations as read.
    times: When each picture was taken [s].
    lens: Columns of `cv2.projectPoints`'s Jacobian that are free.
    readout: The present one [s].
    longest: Of the readout [s].
  """
  camera, moves = camera_of(model), motion(model, times, _SMALL)
  still, ids, pictures = np.zeros(3), [], []
  by_pose, by_point, by_all, errors = [], [], [], []  # all: lens and readout
  for index, (image, sight) in enumerate(zip(registered(model), measured, strict=True)):
    if not len(sight.rows):
      continue
    local, pose = _local_points(model, image, sight.rows), image.cam_from_world()
    pictures.append(len(local))
    ids.append([image.points2D[int(k)].point3D_id for k in sight.rows])
    _, slope = cv2.projectPoints(local, still, still, camera.opencv_matrix, camera.distortion)
    slope, found = slope.reshape(len(local), 2, -1), camera.project(local)
    error = found - np.array([image.points2D[int(k)].xy for k in sight.rows]).reshape(-1, 2)
    ahead = moves.project(local, instants(sight.pixels, camera), index, camera) - found
    weight = (1.0 + np.square(error).sum(-1) / mapping.LOSS_SCALE**2) ** -0.25  # soft L1's root
    weight = weight[:, None, None]
    by_pose.append(weight * slope[..., :6])
    by_point.append(weight * slope[..., 3:6] @ pose.rotation.matrix())
    by_all.append(weight * np.concatenate([slope[..., lens], ahead[..., None]], -1))
    errors.append(weight[..., 0] * error)
  _, point = np.unique(np.concatenate(ids), return_inverse=True)
  sights = Sights(
    picture=np.repeat(np.arange(len(pictures)), pictures),
    point=point,
    by_pose=np.concatenate(by_pose),
    by_point=np.concatenate(by_point),
    shared=np.concatenate(by_all),
    errors=np.concatenate(errors),
  )
  reduced = eliminate(sights, len(pictures), damping=_DAMPING)
  reduced.curvature[-1, -1] += (_SMALL / longest) ** 2
  reduced.gradient[-1] += _SMALL * readout / longest**2
  return _SMALL * float(np.linalg.solve(reduced.curvature, -reduced.gradient)[-1])


def take_out(
  model: pycolmap.Reconstruction,
  times: Mapping[str, float],
  *,
  longest: float,
  principal: bool,
  distortion: bool,
  report: Progress = no_progress,
) -> tuple[pycolmap.Reconstruction, Shutter]:
  """Estimates the readout time and returns the model without its effect, and the motion.

  Args:
    model: Adjusted as if all lines were read at once.
    times: When each picture was taken [s]; they strictly grow and tell the motion (`tells_motion`).
    longest: Of the readout, the period of the film's frames [s]: none is read for longer.
    principal: Whether the lens's principal point is free in adjustments.
    distortion: Whether its distortion is.
    report: Called with the fraction done and a text.
  """
  lens = [*_FOCAL, *(_PRINCIPAL if principal else ()), *(_DISTORTION if distortion else ())]
  result, readout = pycolmap.Reconstruction(model), 0.0
  mapping.drop_points_in_cameras(result)
  measured = _measured(result)
  for done in range(_ROUNDS):
    report(done / _ROUNDS, f"rolling shutter of {1e3 * readout:.1f} ms")
    before = readout
    readout += _change(result, measured, times, lens, readout, longest)
    readout = float(np.clip(readout, -longest, longest))
    _move_observations(result, measured, motion(result, times, readout))
    mapping.adjust(result, principal=principal, distortion=distortion)
    if abs(readout - before) < _PRECISION:
      break
  return result, motion(result, times, readout)


def doubt(readout: float, longest: float) -> str | None:
  """Says what a readout [s] means that was ended by the longest that there can be; None for others.

  A model that is bent fits a longer one than the camera's.
  """
  if abs(readout) < longest:
    return None
  return (
    f"Rolling shutter: its readout came out as long as a frame lasts, {1e3 * longest:.0f} ms, the "
    "most that it can be. Most cameras read faster, and then some pictures have a wrong place: "
    "run it again, or film more slowly."
  )
