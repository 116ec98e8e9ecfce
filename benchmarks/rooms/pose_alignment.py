"""Aligns the keyframes of a scene to its field's pictures; trains with the aligned poses.

Says what errors of the localised poses cost, and whether refining them with the field pays. A
keyframe's pose is moved by Gauss-Newton steps until the field's colours, carried by its depth, are
those of the keyframe, and its localised points stay at their pixels. The scene is one that
`launch/make_scene.py` made.

  python benchmarks/rooms/pose_alignment.py --scene out/living
  python benchmarks/rooms/pose_alignment.py --scene out/living --train localised aligned

Source of the alignment: Lucas and Kanade 1981; with a field: Yen et al. 2021, "iNeRF".
Shapes: P pixels, O localised points that a keyframe sees, H height, W width.
"""

import dataclasses
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import harness
from benchmarks.rooms.field_ablation import read_posed
from nerf2real.core.geometry.cameras import PIXEL_CENTRE, Camera
from nerf2real.scenes.bundle import STAGES
from nerf2real.scenes.field import training as train
from nerf2real.scenes.field.engine.device import num_threads
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.field.views import Views, held_out_rows
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.quality import held_out
from nerf2real.scenes.settings import SceneSettings

_STEPS = 5  # of Gauss-Newton
_STRIDE = (3, 2)  # rows and columns between pixels that take part
_BORDER = 4  # pixels
_BLUR = 0.8  # pixel, of both pictures before they are compared
_SILHOUETTE = 0.08  # relative depth across three pixels from which they show an edge
_SHARE = 0.1  # of a pixel's colours to the cost: neighbours err alike
_POINT_DEVIATION, _POINT_CORE = 0.9, 2.0  # pixel: of a point's error, and where its weight is half
_FEW_POINTS = 130  # keyframes that see fewer are "without_few"'s; a fast pan's in a living room

Variant = Literal["localised", "aligned", "without_few"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the alignment."""

  scene: Path
  """Folder of a scene with its stages."""
  train: tuple[Variant, ...] = ()
  """Poses that a field is trained with, a run each; "without_few" leaves those keyframes out that
  see few localised points."""
  steps: int = 1200
  """Training steps of each run."""
  seed: int = 0
  """Seed of the training."""


class Aligned(NamedTuple):
  """A keyframe's pose as the field's picture has it."""

  pose: np.ndarray  # [4, 4]
  moved_px: float  # root mean square, of the localised size
  color: tuple[float, float]  # median difference before and after [grey level]
  reprojection: tuple[float, float]  # median error of its points before and after [pixel]


def _moved(twist: np.ndarray, points: np.ndarray) -> np.ndarray:
  """Points [..., 3] of the camera's frame after it turned and moved by a small twist [6]."""
  return points - np.cross(twist[:3], points) - twist[3:]


def _slopes(camera: Camera, points: np.ndarray) -> np.ndarray:
  """Derivatives [P, 2, 6] of the pixels of points [P, 3] by the camera's twist."""
  small = 1e-5
  start = camera.project(points)
  ways = [camera.project(_moved(small * axis, points)) - start for axis in np.eye(6)]
  return np.stack(ways, -1) / small


def align(
  found: Localisation, index: int, image: np.ndarray, color: np.ndarray, depth: np.ndarray
) -> Aligned:
  """Aligns a keyframe.

  Args:
    found: The localised keyframes.
    index: Row of the keyframe.
    image: The evened keyframe uint8 [H, W, 3], of the field's picture's size.
    color: The field's picture uint8 [H, W, 3].
    depth: Its depth [H, W].
  """
  camera = found.camera.at_most(image.shape[1])
  shown, drawn = (cv2.GaussianBlur(p.astype(np.float32), (0, 0), _BLUR) for p in (image, color))
  z = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
  window = np.ones((3, 3))
  usable = (z > 0) & (cv2.dilate(z, window) - cv2.erode(z, window) < _SILHOUETTE * z)
  chosen = np.zeros_like(usable)
  chosen[_BORDER : -_BORDER : _STRIDE[0], _BORDER : -_BORDER : _STRIDE[1]] = True
  usable &= chosen
  points = camera.rays()[usable] * z[usable, None]
  gradient = np.stack(
    [cv2.Scharr(drawn, cv2.CV_32F, *o)[usable] / 32 for o in ((1, 0), (0, 1))], -1
  )
  design = np.einsum("pci,pik->pck", gradient, _slopes(camera, points)).reshape(-1, 6)
  start = camera.project(points)

  from_world = np.linalg.inv(found.world_from_camera[index])
  seen = found.tracks.view == index
  local = found.points[found.tracks.point[seen]] @ from_world[:3, :3].T + from_world[:3, 3]
  point_design = _slopes(found.camera, local).reshape(-1, 6)

  twist, history = np.zeros(6), []
  for _ in range(_STEPS):
    place = (camera.project(_moved(twist, points)) - PIXEL_CENTRE).astype(np.float32)
    there = cv2.remap(shown, place[:, None, 0], place[:, None, 1], cv2.INTER_LINEAR)[:, 0]
    error = drawn[usable] - there
    scale = 1.48 * np.median(np.abs(error)) + 0.5
    weight = _SHARE / scale**2 / (1 + np.square(np.linalg.norm(error, axis=-1) / (2 * scale)))
    miss = found.tracks.pixel[seen] - found.camera.project(_moved(twist, local))
    far = np.linalg.norm(miss, axis=-1)
    point_weight = 1 / (_POINT_DEVIATION**2 * (1 + np.square(far / _POINT_CORE)))
    history.append((float(np.median(np.abs(error))), float(np.median(far)) if len(far) else 0.0))
    a = design * np.repeat(weight, 3)[:, None]
    b = point_design * np.repeat(point_weight, 2)[:, None]
    slope = a.T @ error.ravel() + b.T @ miss.ravel()
    twist = twist + np.linalg.solve(a.T @ design + b.T @ point_design, slope)
  shift = camera.project(_moved(twist, points)) - start
  change = np.eye(4)
  change[:3, :3] = Rotation.from_rotvec(-twist[:3]).as_matrix()
  change[:3, 3] = -twist[3:]
  (first, first_px), (last, last_px) = history[0], history[-1]
  return Aligned(
    found.world_from_camera[index] @ np.linalg.inv(change),
    float(np.sqrt(np.square(shift).sum(-1).mean()) * found.camera.width / camera.width),
    (first, last),
    (first_px, last_px),
  )


def _score(renderer: Renderer, views: Views) -> dict[str, harness.Value]:
  size = (views.camera.height, views.camera.width)
  scores = [held_out.compare(renderer, views, index, *size) for index in range(len(views))]
  return {
    "psnr_db": float(np.mean([score.psnr_db for score in scores])),
    "median_psnr_db": float(np.median([score.psnr_db for score in scores])),
    "ssim": float(np.mean([score.ssim for score in scores])),
  }


def main(settings: Settings) -> None:
  """Aligns, trains and prints the table."""
  stages, every = settings.scene / STAGES, SceneSettings().held_out_every
  rendered = np.load(stages / "depth" / "depth.npz")
  posed = read_posed(settings.scene, width=rendered["depth"].shape[2])
  found, views = posed.poses.value, posed.views()
  inputs = zip(views.evened().images, rendered["color"], rendered["depth"], strict=True)
  aligned = [align(found, index, *pictures) for index, pictures in enumerate(inputs)]
  held = held_out_rows(len(views), every)
  figures: dict[str, dict[str, harness.Value]] = {}
  for name, rows in (("trained on", ~held), ("held out", held)):
    group = [a for a, chosen in zip(aligned, rows, strict=True) if chosen]
    moved = [a.moved_px for a in group]
    color, points = (
      np.mean([a.color for a in group], 0),
      np.mean([a.reprojection for a in group], 0),
    )
    figures[name] = {
      "moved_px": float(np.median(moved)),
      "moved_p90_px": float(np.percentile(moved, 90)),
      "color_before": float(color[0]),
      "color_after": float(color[1]),
      "reprojection_before_px": float(points[0]),
      "reprojection_after_px": float(points[1]),
    }
  placed = dataclasses.replace(views, world_from_camera=np.array([a.pose for a in aligned]))
  judging = views.select(np.flatnonzero(held))
  renderer = Renderer(Field.load(stages / "field" / "field.safetensors"), threads=num_threads())
  figures["held out, as localised"] = _score(renderer, judging)
  figures["held out, own poses aligned"] = _score(renderer, placed.select(np.flatnonzero(held)))
  counts = np.bincount(found.tracks.view, minlength=len(views))
  chosen = dataclasses.replace(train.preset("fast"), max_steps=settings.steps, max_seconds=None)
  for variant in settings.train:
    rows = ~held & (counts >= _FEW_POINTS) if variant == "without_few" else ~held
    training = (placed if variant == "aligned" else views).select(np.flatnonzero(rows))
    field, _ = train.train(training.evened(), chosen, seed=settings.seed)
    figures[f"trained, {variant}"] = _score(Renderer(field, threads=num_threads()), judging)
  harness.finish("field_ablation", figures, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
