"""Trains the field with and without blur augmentation and compares the pictures, coarse and fine.

The built-in room at its true poses: what is compared is the field, not the localisation. Both
runs get the same pictures, time and seed. A field without the augmentation has never seen a
coarser pixel than the training camera's; it is scored twice, given the robot's true pixel and given
the training pixel, and the better of the two is what the augmentation is compared with.

  python benchmarks/rooms/blur_ablation.py                # twice 4 minutes on 2 cores
  python benchmarks/rooms/blur_ablation.py --seconds 60

Source: NeRF2Real, section NeRF training (31.5 against 35.4 dB) and the figure of the blur ablation.
"""

import dataclasses

import av
import cv2
import numpy as np

from benchmarks import harness
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.builtin import filming, ground_truth
from nerf2real.scenes.field import training as train
from nerf2real.scenes.field.engine.device import num_threads
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.field.views import Views
from nerf2real.scenes.quality.image_quality import psnr, ssim

SIZES = ((30, 40), (60, 80))  # picture sizes [H, W] of the policies
_UNIT = 2.6  # metres of the built-in room that make a unit: all of it lies in the unit cube
_CENTRE = (0.0, 0.0, 1.25)  # of the room [m]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the ablation."""

  seconds: float = 240.0
  """Training time of each run [s]."""
  keyframes: int = 120
  """Pictures taken from the film: the sharpest of so many equal parts."""
  width: int = 640
  """Width of the training pictures [pixel]."""
  full_every: int = 2
  """At full size one of so many held-out views is scored, which takes the longest."""
  seed: int = 0
  """Seed of the training."""


def unit_from_room() -> Similarity:
  """The unit frame that the runs use."""
  return Similarity(1 / _UNIT, np.eye(3), -np.array(_CENTRE) / _UNIT)


def film_views(settings: Settings) -> Views:
  """Reads keyframes of the shipped film with their true poses in the unit frame."""
  truth = filming.read_truth(ground_truth.TRUTH)
  poses, camera = truth["world_from_camera"], truth["camera"]
  groups = np.array_split(np.arange(len(poses)), settings.keyframes)
  best: dict[int, tuple[float, int, np.ndarray]] = {}
  group_of = {int(i): g for g, group in enumerate(groups) for i in group}
  with av.open(str(ground_truth.VIDEO)) as container:
    for index, frame in enumerate(container.decode(video=0)):
      if index not in group_of:
        break
      image = frame.to_ndarray(format="rgb24")
      gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
      sharpness = float(cv2.Laplacian(gray, cv2.CV_64F).var())
      group = group_of[index]
      if group not in best or sharpness > best[group][0]:
        best[group] = (sharpness, index, image)
  chosen = [best[g] for g in sorted(best)]
  views = Views(
    camera,
    np.stack([image for _, _, image in chosen]),
    unit_from_room().apply_pose(poses[[index for _, index, _ in chosen]]),
    tuple(f"{index:05d}" for _, index, _ in chosen),
  )
  if camera.width == settings.width:
    return views
  return views.resized(settings.width, round(camera.height * settings.width / camera.width))


def robot_views() -> dict[str, Views]:
  """The true pictures of the robot's camera, by size."""
  arrays = np.load(ground_truth.ROBOT_VIEWS)
  poses = unit_from_room().apply_pose(arrays["world_from_camera"])
  names = tuple(str(i) for i in range(len(poses)))
  return {
    f"robot {h}x{w}": Views(
      ground_truth.robot_camera(h, w), arrays[f"images_{h}x{w}"], poses, names
    )
    for h, w in SIZES
  }


def picture(renderer: Renderer, camera: Camera, pose: np.ndarray, *, told_angle: float):
  """Renders uint8 [H, W, 3] as if the camera's pixels spanned `told_angle` [rad]."""
  rays = camera.rays()
  directions = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ pose[:3, :3].T
  origins = np.broadcast_to(pose[:3, 3], directions.shape)
  color, _, _ = renderer.render_rays(origins.reshape(-1, 3), directions.reshape(-1, 3), told_angle)
  return np.rint(255 * np.clip(color, 0, 1)).astype(np.uint8).reshape(rays.shape)


def score(renderer: Renderer, views: Views, *, told_angle: float) -> dict[str, harness.Value]:
  """Mean PSNR [dB] and SSIM over views; the field is given pixels that span `told_angle` [rad]."""
  pairs = [
    (picture(renderer, views.camera, pose, told_angle=told_angle), truth)
    for pose, truth in zip(views.world_from_camera, views.images, strict=True)
  ]
  return {
    "psnr_db": float(np.mean([psnr(drawn, truth) for drawn, truth in pairs])),
    "ssim": float(np.mean([ssim(drawn, truth) for drawn, truth in pairs])),
  }


def main(settings: Settings) -> None:
  """Trains twice and prints the table."""
  training, held_out = film_views(settings).split(8)
  sets = {"held_out": held_out.select(range(0, len(held_out), settings.full_every))}
  for height, width in SIZES:
    sets[f"held_out {height}x{width}"] = held_out.resized(width, height)
  sets.update(robot_views())
  figures: dict[str, dict[str, harness.Value]] = {}
  scores: dict[str, dict[str, list[float]]] = {name: {} for name in sets}  # PSNR by set and blur
  for name, blur_max in (("without_blur", 0.0), ("with_blur", train.preset("fast").blur_max)):
    chosen = dataclasses.replace(
      train.preset("fast"), max_seconds=settings.seconds, blur_max=blur_max
    )
    field, report = train.train(training, chosen, seed=settings.seed)
    figures[f"{name} training"] = {
      "steps": report.steps,
      "training_s": report.seconds,
      "samples_per_s": report.samples_per_second,
    }
    renderer = Renderer(field, threads=num_threads())
    for key, views in sets.items():
      angles = {"": views.camera.pixel_angle}
      if not blur_max and views.camera.pixel_angle > field.training_pixel_angle:
        angles[" told the training pixel"] = field.training_pixel_angle
      for told, angle in angles.items():
        figures[f"{name} {key}{told}"] = row = score(renderer, views, told_angle=angle)
        scores[key].setdefault(name, []).append(float(row["psnr_db"]))  # type: ignore[arg-type]
  for key, by_blur in scores.items():
    gain = max(by_blur["with_blur"]) - max(by_blur["without_blur"])
    figures[f"gain {key}"] = {"gain_db": gain}
  harness.finish("blur_ablation", figures, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
