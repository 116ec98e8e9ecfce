"""Trains the field of a scene with one part of its training changed each; scores held-out views.

Keyframes and poses are those of a scene that `launch/make_scene.py` made or began (`--check` is
enough); all runs get the same steps and seed.

  python benchmarks/rooms/field_ablation.py --scene out/living --steps 2500
  python benchmarks/rooms/field_ablation.py --scene out/living --change falloff near_gradient
  python benchmarks/rooms/field_ablation.py --scene out/living --passers 0.3
  python benchmarks/rooms/field_ablation.py --scene out/living --waiting 0.3

With --passers something stands in a share of the pictures that are trained on, elsewhere in each;
with --waiting somebody waits at one place in the room in as many, one after another, and leaves.
Geometry is judged by localised points of the held-out views: how far the field's surface lies from
them along their sight lines, as a share of their distance.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from benchmarks import harness
from nerf2real.scenes.bundle import STAGES
from nerf2real.scenes.capture import keyframes
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.field import training as train
from nerf2real.scenes.field.engine.device import num_threads
from nerf2real.scenes.field.field import FieldSettings
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.field.views import Views
from nerf2real.scenes.poses import localisation
from nerf2real.scenes.quality import held_out
from nerf2real.scenes.settings import SceneSettings
from nerf2real.scenes.stages.cache import Made, StageResult
from nerf2real.scenes.stages.pictures import PosedPictures

_PASSER = 0.16, 0.7  # width and height of what stands there, of the picture's
_PATCHES = 8  # of colour, along the picture's sides
_WAITING = 0.18, 0.75  # half widths of who waits, of the median distance of localised points
Part = Literal[
  "falloff", "near_gradient", "points", "distortion", "blur", "weights", "rate", "padding", "table"
]
_SHARPER = 3  # times that a picture of the sharper half counts by "weights"
CHANGES: dict[str, dict[str, Any]] = {  # the first turn a part off, but near_gradient, which is off
  "falloff": {},
  "near_gradient": {"near_gradient": 1.0},
  "points": {"anchor_fraction": 0.0, "empty_samples": 0},
  "distortion": {"distortion_weight": 0.0},
  "blur": {"blur_max": 0.0},
  "weights": {},
  "rate": {"final_learning_rate": 3e-4},
  "padding": {"charbonnier_padding": 1e-3},
  "table": {"field": FieldSettings(log2_table_size=19)},
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the ablation."""

  scene: Path
  """Folder of a scene, with its keyframes and poses."""
  steps: int = 2500
  """Training steps of each run."""
  change: tuple[Part, ...] = ("falloff", "near_gradient")
  """Parts of the training that are changed, one a run; the first run changes nothing."""
  passers: float = 0.0
  """Share of the pictures trained on in which something stands that others do not show."""
  waiting: float = 0.0
  """Share of the pictures trained on, one after another, while somebody stands at one place."""
  width: int = 640
  """Width at which held-out views are scored [pixel]."""
  seed: int = 0
  """Seed of the training."""


def read_posed(scene: Path, *, width: int) -> PosedPictures:
  """Finds the localised keyframes of a scene, to be read at a width [pixel]."""

  def stage(name: str) -> StageResult:
    return StageResult(scene / STAGES / name, "", "", 0.0, cached=True)

  taken, poses = stage("keyframes"), stage("poses")
  capture = keyframes.load(taken.folder, taken.folder / "images")
  return PosedPictures(
    Made(capture, taken),
    Made(localisation.load(poses.folder / "sfm"), poses),
    width,
    SceneSettings().held_out_every,
  )


def without_falloff(views: Views) -> Views:
  """Returns the pictures with the gains that they have, and none for the lens."""
  assert views.exposure is not None
  flat = views.exposure._replace(falloff=np.zeros_like(views.exposure.falloff))
  return dataclasses.replace(views, exposure=flat)


def blur_of(capture: Capture) -> dict[str, float]:
  """Blur of each keyframe by its name."""
  return dict(zip((path.name for path in capture.images), capture.blur.tolist(), strict=True))


def by_sharpness(views: Views, blur: Mapping[str, float]) -> Views:
  """Returns the pictures with those of the less blurred half several times, as weights of them."""
  of_each = np.array([blur[name] for name in views.names])
  times = np.where(of_each < np.median(of_each), _SHARPER, 1)
  return views.select(np.repeat(np.arange(len(views)), times))


def with_passers(views: Views, share: float, seed: int) -> Views:
  """Returns the pictures with a coloured upright ellipse, as of a person, in a share of them."""
  rng = np.random.default_rng(seed)
  images = views.images.copy()
  height, width = images.shape[1:3]
  for index in np.flatnonzero(rng.random(len(images)) < share):
    mask = np.zeros((height, width), np.uint8)
    centre = int(width * rng.random()), int(height * rng.uniform(0.4, 0.7))
    axes = int(_PASSER[0] * width / 2), int(_PASSER[1] * height / 2)
    cv2.ellipse(mask, centre, axes, 0, 0, 360, 1, -1)
    clothes = rng.integers(0, 256, (_PATCHES, _PATCHES, 3), np.uint8)
    images[index][mask > 0] = cv2.resize(clothes, (width, height))[mask > 0]
  return dataclasses.replace(views, images=images)


def with_waiting(views: Views, share: float, seed: int) -> Views:
  """Returns the pictures with a coloured ellipse about one place, in a share of them in a row.

  The place is that of a localised point about as far from a picture in the middle of the row as
  half of such points are; nothing hides who stands there.
  """
  rng = np.random.default_rng(seed)
  images = views.images.copy()
  height, width = images.shape[1:3]
  count = round(share * len(images))
  first = int(rng.integers(len(images) - count + 1))
  middle = first + count // 2
  far = np.median(views.anchors[:, 3])
  seen = views.anchors[np.abs(views.anchors[:, 0] - middle) <= 1]
  index, column, row, distance = seen[np.argmin(np.abs(seen[:, 3] - far))]
  ray = np.linalg.inv(views.camera.matrix) @ [column, row, 1.0]
  pose = views.world_from_camera[int(index)]
  place = pose[:3, :3] @ (distance * ray / np.linalg.norm(ray)) + pose[:3, 3]
  clothes = cv2.resize(rng.integers(0, 256, (_PATCHES, _PATCHES, 3), np.uint8), (width, height))
  for picture in range(first, first + count):
    pose = views.world_from_camera[picture]
    at = views.camera.matrix @ (pose[:3, :3].T @ (place - pose[:3, 3]))
    if at[2] <= 0:
      continue
    axes = [max(1, int(half * far * views.camera.matrix[0, 0] / at[2])) for half in _WAITING]
    centre = at[:2] / at[2]
    if np.abs(centre).max() > 10 * width:
      continue
    mask = np.zeros((height, width), np.uint8)
    cv2.ellipse(mask, (int(centre[0]), int(centre[1])), tuple(axes), 0, 0, 360, 1, -1)
    images[picture][mask > 0] = clothes[mask > 0]
  return dataclasses.replace(views, images=images)


def point_errors(renderer: Renderer, held: Views) -> np.ndarray:
  """Distances of the field's surface from localised points, by those points' distance [A]."""
  errors = []
  for index in range(len(held)):
    mine = held.anchors[held.anchors[:, 0] == index]
    if not len(mine):
      continue
    _, depth = renderer.render(held.camera, held.world_from_camera[index])
    column, row = mine[:, 1:3].astype(int).T
    along = np.linalg.norm(held.camera.rays(), axis=-1)[row, column] * depth[row, column]
    errors.append(np.abs(along / mine[:, 3] - 1))
  return np.concatenate(errors)


def small_db(renderer: Renderer, held: Views, height: int, width: int) -> float:
  """Mean PSNR [dB] of held-out views at a policy's size."""
  scores = [held_out.compare(renderer, held, i, height, width).psnr_db for i in range(len(held))]
  return float(np.mean(scores))


def main(settings: Settings) -> None:
  """Trains and prints the table."""
  posed = read_posed(settings.scene, width=SceneSettings().train_width)
  everything = posed.views()
  figures: dict[str, dict[str, harness.Value]] = {}
  for part in ("", *settings.change):
    views = without_falloff(everything) if part == "falloff" else everything
    training, held = views.split(SceneSettings().held_out_every)
    training = training.evened()
    if part == "weights":
      training = by_sharpness(training, blur_of(posed.capture.value))
    if settings.passers:
      training = with_passers(training, settings.passers, settings.seed)
    if settings.waiting:
      training = with_waiting(training, settings.waiting, settings.seed)
    chosen = dataclasses.replace(
      train.preset("fast"), max_steps=settings.steps, max_seconds=None, **CHANGES.get(part, {})
    )
    field, report = train.train(training, chosen, seed=settings.seed)
    renderer = Renderer(field, threads=num_threads())
    height = round(held.camera.height * settings.width / held.camera.width)
    scores = [
      held_out.compare(renderer, held, index, height, settings.width) for index in range(len(held))
    ]
    figures[f"{part} changed" if part else "as it is"] = {
      "psnr_db": float(np.mean([score.psnr_db for score in scores])),
      "ssim": float(np.mean([score.ssim for score in scores])),
      **{f"psnr_{h}x{w}_db": small_db(renderer, held, h, w) for h, w in held_out.ROBOT_SIZES},
      "points_off_median": float(np.median(off := point_errors(renderer, held))),
      "points_off_95": float(np.percentile(off, 95)),
      "samples_per_ray": report.samples / report.rays,
      "training_s": report.seconds,
    }
  harness.finish("field_ablation", figures, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
