"""Stages of the radiance field: points for it by stereo, its training, its depth from the cameras.

Each runs, or finds done, one stage of the cache: a function of earlier results and settings.
"""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.progress import Progress
from nerf2real.core.serialization import write_json
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.capture.posed import depth_pictures
from nerf2real.scenes.field import training
from nerf2real.scenes.field.render import renderer
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.field.views import held_out_rows
from nerf2real.scenes.geometry import fusion
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.stages.cache import Made, Stages
from nerf2real.scenes.stages.pictures import PosedPictures
from nerf2real.scenes.stages.results import TrainedField
from nerf2real.scenes.stereo import dense

# 2: the lens's falloff is taken out of the pictures; 3: what is near a camera may be there
_FIELD_VERSION = 3


def stereo(
  cache: Stages, pictures: PosedPictures, settings: dense.StereoSettings
) -> Made[np.ndarray]:
  """Finds points by stereo, anchors [A, 4] of the pictures that are not held out.

  None of more pictures than the settings allow, and none where a sensor measured depth.
  """
  count = len(pictures.poses.value.names)
  trained = int((~held_out_rows(count, pictures.held_out_every)).sum())

  def write(folder: Path, progress: Progress) -> None:
    points = np.zeros((0, 4), np.float32)
    if trained <= settings.most_pictures and not pictures.measured:
      views = pictures.training().evened()
      points = dense.dense_points(views, settings, progress=progress)
    np.save(folder / "points.npy", points)

  everything = {
    "stereo": settings,
    "held_out_every": pictures.held_out_every,
    "train_width": pictures.width,
  }
  stage = cache.run("stereo", write, settings=everything, inputs={"poses": pictures.poses.stamp})
  return Made(np.load(stage.folder / "points.npy"), stage)


def field(
  cache: Stages,
  pictures: PosedPictures,
  points: Made[np.ndarray],
  settings: TrainSettings,
  *,
  show: Callable[[training.Snapshot], None] | None = None,
) -> Made[TrainedField]:
  """Trains the radiance field on all pictures that are not held out; `show` sees it grow.

  Args:
    cache: The stages of the job.
    pictures: The pictures.
    points: What stereo found in them, anchors [A, 4].
    settings: Settings.
    show: Sees the field grow.
  """

  def write(folder: Path, progress: Progress) -> None:
    views = pictures.training().evened()
    trained, outcome = training.train(
      dataclasses.replace(views, anchors=np.concatenate([views.anchors, points.value])),
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
  inputs = {"poses": pictures.poses.stamp, "stereo": points.stamp}
  if pictures.measured:
    inputs["keyframes"] = pictures.capture.stamp
  stage = cache.run("field", write, settings=everything, inputs=inputs, version=_FIELD_VERSION)
  return Made(TrainedField(stage.folder / "field.safetensors"), stage)


def depth(
  cache: Stages,
  field: Made[TrainedField],
  capture: Made[Capture],
  poses: Made[Localisation],
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
    camera = found.camera.at_most(width)
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
  if capture.value.has_depth:
    inputs["keyframes"] = capture.stamp
  stage = cache.run("depth", write, settings=width, inputs=inputs, version=renderer.VERSION)
  arrays = np.load(stage.folder / "depth.npz")
  views = fusion.DepthViews(
    camera=found.camera.at_most(width),
    frame_from_camera=found.world_from_camera,
    depth=arrays["depth"],
    color=arrays["color"],
  )
  return Made(views, stage)


def _measured_depth(capture: Capture, poses: Localisation, camera: Camera) -> np.ndarray | None:
  """Sensor's depth of the localised keyframes [N, H, W] [unit], 0 where none; None without one."""
  known = capture.known
  if known is None or not known.depth_files:
    return None
  files = {image.name: file for image, file in zip(capture.images, known.depth_files, strict=True)}
  unit = known.depth_unit * poses.unit_from_source.scale
  named = (files[name] for name in poses.names)
  return np.stack([depth_pictures.measured_depth(file, unit, camera) for file in named])
