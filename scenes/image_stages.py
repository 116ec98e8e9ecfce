"""Stages that work on pictures: keyframes, poses, radiance field, depth, figures, baseline.

Each runs, or finds done, one stage of the cache: a function of earlier results and settings.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core.cameras import Camera
from nerf2real.core.progress import Progress
from nerf2real.core.serialization import write_json
from nerf2real.scenes.capture import depth_pictures
from nerf2real.scenes.capture import keyframes as keyframe_files
from nerf2real.scenes.capture.capture import Capture, CaptureSettings, read_capture
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.field import photometry, training
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.geometry import fusion
from nerf2real.scenes.geometry import poisson as poisson_meshes
from nerf2real.scenes.pictures import PosedPictures
from nerf2real.scenes.poses import localise
from nerf2real.scenes.quality import held_out, image_quality
from nerf2real.scenes.results import Source, TrainedField
from nerf2real.scenes.stages import Made, Stages

_POSES_VERSION = 3  # 2: the unit frame's yaw; 3: the rolling shutter is taken out
_PICTURES_VERSION = 2  # 2: stills turned and without copies; depth checked with the pictures
_FIELD_VERSION = 2  # 2: the lens's falloff is taken out of the pictures


def keyframes(cache: Stages, source: Source, settings: CaptureSettings) -> Made[Capture]:
  """Takes the sharpest frames of a capture."""

  def write(folder: Path, progress: Progress) -> None:
    taken = read_capture(source.path, folder / "images", settings=settings, progress=progress)
    keyframe_files.save(taken, folder)

  version = 1 if source_kind(source.path) == "video" else _PICTURES_VERSION
  inputs = {"source": source.sha256}
  stage = cache.run("keyframes", write, settings=settings, inputs=inputs, version=version)
  return Made(keyframe_files.load(stage.folder, stage.folder / "images"), stage)


def poses(
  cache: Stages, capture: Made[Capture], settings: localise.LocaliseSettings
) -> Made[localise.Localisation]:
  """Estimates the camera, its poses and sparse points by structure from motion."""

  def write(folder: Path, progress: Progress) -> None:
    taken = capture.value
    times = None
    if taken.times is not None:
      times = dict(zip([path.name for path in taken.images], taken.times.tolist(), strict=True))
    names = [path.name for path in taken.images]
    turned = np.zeros(len(names), bool) if taken.turned is None else taken.turned
    try:
      localise.localise(
        taken.folder,
        folder,
        settings=settings,
        known=taken.known,
        times=times,
        turned=frozenset(name for name, is_so in zip(names, turned, strict=True) if is_so),
        progress=progress,
      )
    except localise.LocalisationError as error:
      if taken.origins is None or not error.missing:
        raise
      lost = taken.called(np.isin(names, sorted(error.missing)), most=4)
      raise localise.LocalisationError(f"{error} Without a place: {lost}.") from error
    shutil.rmtree(folder / "work", ignore_errors=True)  # features and matches: large

  inputs = {"keyframes": capture.stamp}
  stage = cache.run("poses", write, settings=settings, inputs=inputs, version=_POSES_VERSION)
  return Made(localise.load(stage.folder / "sfm"), stage)


def field(
  cache: Stages,
  pictures: PosedPictures,
  settings: TrainSettings,
  *,
  show: Callable[[training.Snapshot], None] | None = None,
) -> Made[TrainedField]:
  """Trains the radiance field on all pictures that are not held out; `show` sees it grow."""

  def write(folder: Path, progress: Progress) -> None:
    trained, outcome = training.train(
      pictures.training().evened(),
      settings,
      progress=progress,
      checkpoint_dir=folder / "checkpoints",
      show=show,
    )
    trained.save(folder / "field.safetensors")
    write_json(folder / "training.json", outcome)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)

  everything = {
    "train": settings,
    "held_out_every": pictures.held_out_every,
    "train_width": pictures.width,
  }
  inputs = {"poses": pictures.poses.stamp}
  stage = cache.run("field", write, settings=everything, inputs=inputs, version=_FIELD_VERSION)
  return Made(TrainedField(stage.folder / "field.safetensors"), stage)


def depth(
  cache: Stages,
  field: Made[TrainedField],
  capture: Made[Capture],
  poses: Made[localise.Localisation],
  *,
  width: int,
) -> Made[fusion.DepthViews]:
  """Renders depth and colour of the field where the capture's cameras stood, in the unit frame.

  Where a depth sensor measured, its depth takes the place of the field's.

  Args:
    cache: The stages of the job.
    field: The field.
    capture: The keyframes, which may have come with measured depth.
    poses: The cameras.
    width: Of the pictures; at most that of the keyframes [pixel].
  """
  found = poses.value

  def write(folder: Path, progress: Progress) -> None:
    columns = min(width, found.camera.width)
    camera = found.camera.resized(
      columns, round(found.camera.height * columns / found.camera.width)
    )
    pictures = []
    for index, pose in enumerate(found.world_from_camera):
      pictures.append(field.value.renderer.render(camera, pose))
      total = len(found.world_from_camera)
      progress((index + 1) / total, f"picture {index + 1} of {total}")
    color, distance = (np.stack(part) for part in zip(*pictures, strict=True))
    measured = _measured_depth(capture.value, found, camera)
    if measured is not None:
      distance = np.where(measured > 0, measured, distance)
    np.savez(folder / "depth.npz", color=color, depth=distance)

  inputs = {"field": field.stamp, "poses": poses.stamp}
  if capture.value.known is not None and capture.value.known.depth_files:
    inputs["keyframes"] = capture.stamp
  stage = cache.run("depth", write, settings=width, inputs=inputs)
  arrays = np.load(stage.folder / "depth.npz")
  rows, columns = arrays["depth"].shape[1:]
  views = fusion.DepthViews(
    camera=found.camera.resized(columns, rows),
    frame_from_camera=found.world_from_camera,
    depth=arrays["depth"],
    color=arrays["color"],
  )
  return Made(views, stage)


def _measured_depth(
  capture: Capture, poses: localise.Localisation, camera: Camera
) -> np.ndarray | None:
  """Sensor's depth of the localised keyframes [N, H, W] [unit], 0 where none; None without one."""
  known = capture.known
  if known is None or not known.depth_files:
    return None
  files = {image.name: file for image, file in zip(capture.images, known.depth_files, strict=True)}
  unit = known.depth_unit * poses.unit_from_source.scale
  return np.stack(
    [depth_pictures.measured_depth(files[name], unit, camera) for name in poses.names]
  )


def figures(
  cache: Stages, field: Made[TrainedField], pictures: PosedPictures
) -> Made[dict[str, float]]:
  """Scores the field on the held-out pictures."""

  def write(folder: Path, progress: Progress) -> None:
    views = pictures.held_out()
    scores, found = held_out.evaluate(field.value.renderer, views, progress=progress)
    if views.exposure is not None:
      found["exposure_ratio"] = views.exposure.ratio
      found["corner_light"] = views.exposure.corner
    held_out.save_scores(scores, folder)
    write_json(folder / "figures.json", found)

  inputs = {"field": field.stamp}
  stage = cache.run("figures", write, settings=pictures.held_out_every, inputs=inputs)
  return Made(json.loads((stage.folder / "figures.json").read_text()), stage)


def baseline(cache: Stages, pictures: PosedPictures) -> Made[dict[str, float]]:
  """Renders the paper's baseline, the Poisson mesh of the COLMAP points, at held-out views."""
  poses = pictures.poses

  def write(folder: Path, progress: Progress) -> None:
    found, views = poses.value, pictures.held_out()
    progress(0.0, "Poisson mesh")
    surface = poisson_meshes.poisson_mesh(
      found.points, found.point_colors, camera_positions=found.world_from_camera[:, :3, 3]
    )
    drawn: dict[str, Any] = {}
    for index, name in enumerate(views.names):
      pose = views.world_from_camera[index]
      picture = poisson_meshes.render_mesh(surface, views.camera, pose)[0]
      if views.exposure is not None:
        picture = photometry.expose(picture, views.exposure.factors(index, views.camera))
      drawn[name] = picture
      progress((index + 1) / (len(views) + 1), f"view {index + 1} of {len(views)}")
    np.savez(folder / "views.npz", **drawn)
    quality = [
      image_quality.psnr(drawn[name], views.images[index]) for index, name in enumerate(views.names)
    ]
    write_json(folder / "figures.json", {"baseline_psnr_db": float(np.mean(quality))})

  inputs = {"poses": poses.stamp}
  stage = cache.run("baseline", write, settings=pictures.held_out_every, inputs=inputs)
  return Made(json.loads((stage.folder / "figures.json").read_text()), stage)
