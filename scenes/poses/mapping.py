"""Maps verified matches to one refined COLMAP model: incremental or global."""

import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.capture.posed.colmap_model import camera_of, to_colmap
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.matching.features import image_ids, quiet

MIN_OBSERVATIONS = 20  # points a picture must see to count as registered
MAX_ERROR = 4.0  # observations further off are dropped [pixel]; COLMAP
MIN_ANGLE = 1.5  # points seen under a smaller angle are dropped [degree]; COLMAP
_NEAREST = 0.02  # of a picture's median depth, chosen: nearer points lie in it, 6 cm in a room
LOSS_SCALE = 1.0  # of the soft L1 loss in the final adjustment [pixel]
_MAX_PRINCIPAL_SHIFT = 0.08  # of the principal point from the middle, times the picture's size
_MAX_FOCAL_CHANGE = 0.05  # of the focal length when the principal point is freed, relative
_LEAST_SLOPE = 0.2  # of the radial polynomial, up to a picture's corners
_WIDEST = 3.0  # times its corner: so far off is looked for what a picture shows there
_MAX_ASPECT = 0.05  # of fx / fy from 1; phones and cameras have square pixels
NOTHING = (ValueError, RuntimeError)  # what pycolmap raises


def map_globally(
  database: Path, images_folder: Path, *, seed: int, report: Progress = no_progress
) -> list[pycolmap.Reconstruction]:
  """Solves for all rotations, then all positions, then adjusts; the largest model first.

  Source: Pan et al. 2024, Global structure-from-motion revisited (GLOMAP). It does not fall into
  pieces at weak links as the incremental mapper does.
  """
  options = pycolmap.GlobalPipelineOptions()
  options.num_threads = os.cpu_count() or 1
  options.random_seed = seed
  report(0.0, "solving for all poses at once")
  with tempfile.TemporaryDirectory(dir=database.parent) as folder:
    # The global mapper writes calibrated focal lengths into its database: it gets its own copy.
    copy = Path(folder) / "database.db"
    shutil.copyfile(database, copy)
    models = Path(folder) / "models"
    models.mkdir()
    try:
      with quiet():
        found = pycolmap.global_mapping(str(copy), str(images_folder), str(models), options=options)
    except NOTHING:  # no connected pictures: the other mapper is tried, then the count is reported
      found = {}
  return _largest_first(found)


def map_incrementally(
  database: Path, images_folder: Path, *, seed: int, report: Progress = no_progress
) -> list[pycolmap.Reconstruction]:
  """Adds picture after picture; the largest model first."""
  options = incremental_options(seed)
  total, seen = len(image_ids(database)), 0

  def next_image() -> None:
    nonlocal seen
    seen += 1
    report(min(1.0, seen / total), f"placed {min(seen, total)} of {total} pictures")

  with tempfile.TemporaryDirectory(dir=database.parent) as folder:
    try:
      with quiet():
        found = pycolmap.incremental_mapping(
          str(database), str(images_folder), folder, options=options, next_image_callback=next_image
        )
    except NOTHING:
      found = {}
  return _largest_first(found)


def incremental_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
  """Returns how pictures are added one after the other.

  Thresholds are softer than COLMAP's: a blurred keyframe between two halves of a room has few
  matches, and refusing it splits the model (living room: 82 + 69 keyframes, with these 151). All
  is adjusted whenever the model has grown by a quarter, not by a tenth: three drawn rooms are as
  exact in 0.6 to 0.8 of the time.
  """
  options = pycolmap.IncrementalPipelineOptions()
  options.num_threads = os.cpu_count() or 1
  options.random_seed = seed
  options.extract_colors = False
  options.triangulation.ignore_two_view_tracks = False
  options.mapper.abs_pose_min_num_inliers = 15
  options.mapper.abs_pose_min_inlier_ratio = 0.15
  options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.25
  options.ba_global_max_refinements = 2
  options.ba_global_max_num_iterations = 30
  options.ba_local_max_num_iterations = 15
  return options


def _largest_first(models: dict[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
  return sorted(models.values(), key=lambda model: -model.num_reg_images())


def registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
  """Pictures with a pose, sorted by name."""
  return sorted((i for i in model.images.values() if i.has_pose), key=lambda image: image.name)


def drop_weak_images(model: pycolmap.Reconstruction) -> int:
  """Takes the pose from pictures that see too few points to be trusted; returns their number."""
  weak = [i for i in registered(model) if i.num_points3D < MIN_OBSERVATIONS]
  for image in weak:
    model.deregister_frame(image.frame_id)
  return len(weak)


class Anchors(NamedTuple):
  """Where something else than features says that pictures were taken."""

  positions: Mapping[str, np.ndarray]
  """Of pictures, by their names [3], in the model's unit and near its frame."""
  deviation: float
  """Standard deviation of each along an axis."""


def adjust(
  model: pycolmap.Reconstruction,
  *,
  principal: bool,
  distortion: bool,
  anchors: Anchors | None = None,
  loss: float = LOSS_SCALE,
) -> None:
  """Adjusts poses, points, focal lengths and, where chosen, principal point and distortion.

  Args:
    model: Changed in place.
    principal: Whether the principal point is free.
    distortion: Whether the distortion is.
    anchors: What holds the positions besides the pictures.
    loss: Error beyond which an observation counts less [pixel].
  """
  options = pycolmap.BundleAdjustmentOptions()
  options.refine_principal_point = principal
  options.refine_extra_params = distortion
  options.print_summary = False
  options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
  options.ceres.loss_function_scale = loss
  options.ceres.solver_options.num_threads = os.cpu_count() or 1
  options.ceres.solver_options.max_num_iterations = 50
  options.ceres.solver_options.function_tolerance = 1e-6
  config = pycolmap.BundleAdjustmentConfig()
  for image in registered(model):
    config.add_image(image.image_id)
  with quiet():  # pycolmap.bundle_adjustment writes to the terminal whatever the log level
    if anchors is None:
      config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
      pycolmap.create_default_bundle_adjuster(options, config, model).solve()
      return
    priors = [
      pycolmap.PosePrior(
        corr_data_id=image.data_id,
        position=anchors.positions[image.name],
        position_covariance=anchors.deviation**2 * np.eye(3),
        coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
      )
      for image in registered(model)
      if image.name in anchors.positions
    ]
    how = pycolmap.PosePriorBundleAdjustmentOptions()
    how.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    pycolmap.create_pose_prior_bundle_adjuster(options, how, config, priors, model).solve()


def drop_bad_observations(model: pycolmap.Reconstruction) -> None:
  """Drops observations far from their point, and points seen under a small angle only or that lie
  in a camera."""
  with quiet():
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR, MIN_ANGLE)
  drop_points_in_cameras(model)


def drop_points_in_cameras(model: pycolmap.Reconstruction) -> None:
  """Drops points that lie in a camera that sees them: it shows them anywhere, the least motion
  moves them by more than a picture, and an adjustment ends before it has settled."""
  found = set[int]()
  for image in registered(model):
    ids = [place.point3D_id for place in image.points2D if place.has_point3D()]
    if ids:
      pose = image.cam_from_world().matrix()
      depth = np.array([model.points3D[k].xyz for k in ids]) @ pose[2, :3] + pose[2, 3]
      found.update(np.array(ids)[depth < _NEAREST * np.median(depth)].tolist())
  for point in found:
    model.delete_point3D(point)


def _adjust(
  model: pycolmap.Reconstruction, *, principal: bool, distortion: bool, anchors: Anchors | None
) -> None:
  adjust(model, principal=principal, distortion=distortion, anchors=anchors)
  drop_bad_observations(model)


def camera_fault(camera: Camera) -> str | None:
  """Returns what is impossible about an estimated camera, None if nothing is.

  The radial polynomial r (1 + k1 r^2 + k2 r^4) must reach the farthest corner while it grows: where
  parallax is low, distortion trades against depth and folds the picture.
  """
  x = max(camera.cx, camera.width - camera.cx) / camera.fx
  y = max(camera.cy, camera.height - camera.cy) / camera.fy
  corner = np.hypot(x, y)
  radius = np.linspace(0, _WIDEST * corner, 300)
  slope = 1 + 3 * camera.k1 * radius**2 + 5 * camera.k2 * radius**4
  grows = np.logical_and.accumulate(slope >= _LEAST_SLOPE)
  shown = radius * (1 + camera.k1 * radius**2 + camera.k2 * radius**4)
  if shown[grows].max() < corner:
    return f"distortion k1={camera.k1:.2f}, k2={camera.k2:.2f} folds the picture's corners"
  shift_x = abs(camera.cx / camera.width - 0.5)
  shift_y = abs(camera.cy / camera.height - 0.5)
  if max(shift_x, shift_y) > _MAX_PRINCIPAL_SHIFT:
    return f"principal point ({camera.cx:.0f}, {camera.cy:.0f}) is far from the middle"
  if abs(camera.fx / camera.fy - 1) > _MAX_ASPECT:
    return f"focal lengths {camera.fx:.0f} and {camera.fy:.0f} differ"
  return None


def moved_fault(before: Camera, after: Camera) -> str | None:
  """Returns what is wrong about how an estimate of a camera moved it, None if nothing is."""
  change = after.fx / before.fx - 1
  return f"it moves the focal length by {change:+.1%}" if abs(change) > _MAX_FOCAL_CHANGE else None


class FreeLens(NamedTuple):
  """Parameters of the lens that pictures determine, beside the focal lengths."""

  distortion: bool
  principal: bool
  words: str  # which are free, and why not all


def refine(
  model: pycolmap.Reconstruction,
  *,
  anchors: Anchors | None = None,
  report: Progress = no_progress,
) -> tuple[pycolmap.Reconstruction, FreeLens]:
  """Adjusts poses, points and all parameters of the lens; frees fewer where the result is absurd.

  Parameters are freed in the order focal lengths, distortion, principal point. When an estimate is
  impossible (`camera_fault`), or the principal point moves the focal length by more than 5 %, the
  adjustment is repeated with fewer free parameters; distortion that stays absurd is set to zero.

  Returns:
    The refined model and the free parameters of the lens.
  """
  report(0.0, "adjusting poses and lens")
  model = pycolmap.Reconstruction(model)
  drop_points_in_cameras(model)
  base = pycolmap.Reconstruction(model)
  _adjust(base, principal=False, distortion=True, anchors=anchors)
  fault = camera_fault(camera_of(base))
  if fault is not None:
    base = pycolmap.Reconstruction(model)
    for camera in base.cameras.values():
      camera.params = np.concatenate([camera.params[:4], np.zeros(4)])
    _adjust(base, principal=False, distortion=False, anchors=anchors)
    words = f"focal lengths only, no distortion, because {fault}"
    return base, FreeLens(distortion=False, principal=False, words=words)
  report(0.5, "adjusting poses and lens, principal point free")
  full = pycolmap.Reconstruction(base)
  _adjust(full, principal=True, distortion=True, anchors=anchors)
  fault = camera_fault(camera_of(full)) or moved_fault(camera_of(base), camera_of(full))
  if fault is not None:
    words = f"all OPENCV parameters but the principal point, because {fault}"
    return base, FreeLens(distortion=True, principal=False, words=words)
  return full, FreeLens(distortion=True, principal=True, words="all OPENCV parameters")


def model_from_poses(known: KnownPoses, names: list[str], ids: dict[str, int] | None = None):
  """Builds a COLMAP model of known poses with the known points, which get no observations.

  Args:
    known: Poses and camera of the pictures as written.
    names: Of the pictures, in the order of the poses.
    ids: Ids of the pictures in a database; counted from 1 if None.
  """
  model = pycolmap.Reconstruction()
  model.add_camera_with_trivial_rig(to_colmap(known.camera))
  for number, (name, pose) in enumerate(zip(names, known.world_from_camera, strict=True), start=1):
    image = pycolmap.Image(name=name, camera_id=1, image_id=number if ids is None else ids[name])
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(pose)[:3]))
  for xyz, color in zip(known.points, known.point_colors, strict=True):
    model.add_point3D(xyz, pycolmap.Track(), color)
  return model


def triangulate(
  database: Path,
  images_folder: Path,
  known: KnownPoses,
  names: list[str],
  *,
  max_error: float = MAX_ERROR,
) -> pycolmap.Reconstruction:
  """Triangulates verified matches with poses and camera held fixed.

  Args:
    database: Features and matches.
    images_folder: Where the pictures lie.
    known: Their poses and camera.
    names: The pictures, in the order of the poses.
    max_error: Observations further off are dropped [pixel].
  """
  model = model_from_poses(known, names, image_ids(database))
  options = pycolmap.IncrementalPipelineOptions()
  options.num_threads = os.cpu_count() or 1
  options.extract_colors = False
  options.ba_refine_focal_length = False
  options.ba_refine_extra_params = False
  options.mapper.filter_max_reproj_error = max_error
  options.triangulation.complete_max_reproj_error = max_error
  options.triangulation.merge_max_reproj_error = max_error
  with tempfile.TemporaryDirectory(dir=database.parent) as folder, quiet():
    return pycolmap.triangulate_points(
      model, str(database), str(images_folder), folder, options=options
    )
