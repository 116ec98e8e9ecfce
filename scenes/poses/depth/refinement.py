"""Refines metric poses and the lens that came with pictures of a depth camera.

A tracker's poses are off by a degree and its lens is nominal: more than a field or a surface of
2 cm bears. Features are matched between pictures that look at the same place, triangulated with the
poses as they came, and poses, points and lens adjusted together; the result is moved back onto the
poses that came, which are metric. These hold, lightly, what sees little: plain walls. Shapes: N
pictures.
"""

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.scenes.capture.posed import agreement
from nerf2real.scenes.capture.posed.colmap_model import camera_of, to_colmap
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.localisation import poses_of
from nerf2real.scenes.poses.matching import features
from nerf2real.scenes.poses.matching.pairs import Pair
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.work import Mapped, Steps, prepare_work

_PARTNERS = 10  # pictures each is matched with; chosen: as COLMAP's sequence of ten
_SAME_VIEW = np.cos(np.radians(60.0))  # of the optical axes of a pair
_LOOSE = 16.0  # pixels that poses of a degree may be off at first, in a view of a thousand
_TRIANGULATED = 0.15  # of the progress of both rounds: where one's points are made
_MEDIAN = 0.6745  # of the size of a normal variable, in standard deviations
_LIGHTLY = 3.0  # times their deviations; chosen: a tracker errs alike in pictures near each other
_ASTRAY = 4.0  # times what half of them turn; six deviations of a tracker's errors about three axes
_LITTLE = 0.5  # of the points that half of them see
_EXACT = 1e-4  # m that places err by at least
_FEWEST = 0.5  # of the pictures must see enough points, or the poses stay as they came


def localise_known(
  images_folder: Path,
  work: Path,
  names: list[str],
  settings: LocaliseSettings,
  known: KnownPoses,
  steps: Steps,
) -> Mapped | None:
  """Metric poses adjusted to the pictures; None where the pictures then agree less with the depth.

  Poses say what overlaps, and small steps lie between: plain features of few pairs do.
  """
  plain = dataclasses.replace(settings.features, affine_shape=False, guided_matching=False)
  database = prepare_work(
    images_folder, work, names, dataclasses.replace(settings, features=plain), known
  )
  steps.begin("features")
  features.extract_features(
    database,
    images_folder,
    names,
    settings=plain,
    report=steps.report,
    camera=to_colmap(known.camera),
  )
  steps.begin("matching")
  features.match_pairs(
    database,
    pairs_of(known),
    settings=plain,
    seed=settings.seed,
    report=steps.report,
  )
  steps.begin("refining")
  found = refine_known(database, images_folder, known, names, report=steps.report)
  if found is None:
    return None
  refined, model = found
  images = [images_folder / name for name in names]
  before, after = agreement.distances([known, refined], images)
  if not after < before:
    return None
  model.update_point_3d_errors()
  model.extract_colors_for_all_images(str(images_folder))
  with_sensor(refined, model, names)
  words = (
    f"poses of the {known.kind} source, adjusted with the lens to the pictures: measured depth "
    f"then lies {after:.1f} pixels off in neighbouring pictures, before {before:.1f}"
  )
  return Mapped(model, words, ())


def pairs_of(known: KnownPoses) -> list[Pair]:
  """Pairs each picture with those that look at the same place in nearly the same direction."""
  poses = known.world_from_camera
  distance = float(np.median(known.sightings[:, 3])) if len(known.sightings) else 0.0
  looked_at = poses[:, :3, 3] + distance * poses[:, :3, 2]
  apart = np.linalg.norm(looked_at[:, None] - looked_at, axis=-1)
  apart[poses[:, :3, 2] @ poses[:, :3, 2].T < _SAME_VIEW] = np.inf
  np.fill_diagonal(apart, np.inf)
  chosen: set[Pair] = set()
  for index, row in enumerate(apart):
    for other in np.argsort(row, kind="stable")[:_PARTNERS]:
      if np.isfinite(row[other]):
        chosen.add((int(min(index, other)), int(max(index, other))))
  return sorted(chosen)


def refine_known(
  database: Path,
  images_folder: Path,
  known: KnownPoses,
  names: list[str],
  *,
  report: Progress = no_progress,
) -> tuple[KnownPoses, pycolmap.Reconstruction] | None:
  """Adjusts poses and lens to verified matches; None where pictures share too few.

  Args:
    database: Features and matches of the pictures.
    images_folder: Where they lie.
    known: Their metric poses, in the order of the names.
    names: The pictures.
    report: Called with the fraction done and a text.

  Returns:
    The refined poses, and the model with the points that carry them, both in the frame of the
    poses that came. Pictures that see too few points, and those that see little and turn away from
    the poses that they came with as no others do, keep those.
  """
  empty = np.zeros((0, 3))
  bare = dataclasses.replace(known, points=empty, point_colors=empty.astype(np.uint8))
  found, anchors = bare, None
  for share, error in ((0.0, _LOOSE), (0.5, mapping.MAX_ERROR)):
    report(share, f"points of {len(names)} pictures, matches within {error:g} pixels")
    model = mapping.triangulate(database, images_folder, found, names, max_error=error)
    strong = {i.name for i in mapping.registered(model) if _carries(i)}
    if len(strong) < max(3, _FEWEST * len(names)):
      return None
    for image in mapping.registered(model):
      if image.name not in strong:
        model.deregister_frame(image.frame_id)
    model, _ = mapping.refine(
      model, anchors=anchors, report=part(report, share + _TRIANGULATED, share + 0.5)
    )
    found = _let_go(model, bare, _moved_back(model, bare, names), names)
    anchors = _anchors(bare, found, names)
  return known.with_views(found.camera, found.world_from_camera), model


def _anchors(known: KnownPoses, refined: KnownPoses, names: list[str]) -> mapping.Anchors:
  """The places that came, held lightly: what sees little is held by them, what sees much is not."""
  places = known.world_from_camera[:, :3, 3]
  moved = np.abs(refined.world_from_camera[:, :3, 3] - places)
  moved = moved[moved.any(axis=1)]
  deviation = float(np.median(moved)) / _MEDIAN if len(moved) else 0.0
  held = dict(zip(names, places, strict=True))
  return mapping.Anchors(held, _LIGHTLY * max(deviation, _EXACT))


def _let_go(
  model: pycolmap.Reconstruction, known: KnownPoses, refined: KnownPoses, names: list[str]
) -> KnownPoses:
  """Gives pictures that see little and turn far from the poses that came those again.

  The model loses them (in place). One that sees much may turn: then the tracker has slipped.
  """
  images = mapping.registered(model)
  rows = [names.index(image.name) for image in images]
  poses = np.array(refined.world_from_camera)
  before = known.world_from_camera[rows, :3, :3]
  turns = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ poses[rows, :3, :3]).magnitude()
  points = np.array([image.num_points3D for image in images])
  astray = (turns > _ASTRAY * np.median(turns)) & (points < _LITTLE * np.median(points))
  for image, row, leaves in zip(images, rows, astray, strict=True):
    if leaves:
      model.deregister_frame(image.frame_id)
      poses[row] = known.world_from_camera[row]
  return dataclasses.replace(refined, world_from_camera=poses)


def _carries(image: pycolmap.Image) -> bool:
  return image.num_points3D >= mapping.MIN_OBSERVATIONS


def _moved_back(model: pycolmap.Reconstruction, known: KnownPoses, names: list[str]) -> KnownPoses:
  """Moves a model (in place) onto the known poses, and returns those with the model's in place."""
  images = mapping.registered(model)
  rows = [names.index(image.name) for image in images]
  poses = np.array(known.world_from_camera)
  back = Similarity.fit(poses_of(images)[:, :3, 3], poses[rows, :3, 3])
  model.transform(pycolmap.Sim3d(back.matrix))
  poses[rows] = poses_of(images)
  camera = camera_of(model)
  return dataclasses.replace(known, camera=camera, world_from_camera=poses)


def with_sensor(known: KnownPoses, model: pycolmap.Reconstruction, names: list[str]) -> None:
  """Adds to a refined model (in place) the pictures that it has not, and the sensor's points."""
  present = {image.name for image in mapping.registered(model)}
  for image in model.images.values():
    if image.name not in present:
      inverse = np.linalg.inv(known.world_from_camera[names.index(image.name)])
      image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(inverse[:3]))
      model.register_frame(image.frame_id)
  for xyz, color in zip(known.points, known.point_colors, strict=True):
    model.add_point3D(xyz, pycolmap.Track(), color)
