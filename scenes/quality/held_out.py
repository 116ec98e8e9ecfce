"""Scores a field on held-out pictures, at full and at robot resolution.

Shapes: N views, H height, W width.
"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.core.serialization import write_json
from nerf2real.scenes.field import photometry
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.field.views import Views
from nerf2real.scenes.quality import image_quality

ROBOT_SIZES = ((30, 40), (60, 80))  # picture sizes [H, W] of the policies; paper, table I


@dataclasses.dataclass(frozen=True)
class ViewScore:
  """One held-out view, rendered and compared."""

  name: str
  truth: np.ndarray
  """uint8 [H, W, 3]."""
  image: np.ndarray
  """uint8 [H, W, 3]."""
  depth: np.ndarray
  """float32 [H, W]."""
  psnr_db: float
  ssim: float


def compare(renderer: Renderer, views: Views, index: int, height: int, width: int) -> ViewScore:
  """Renders one view at a size and compares it with the picture averaged over its pixels.

  The field's picture gets the exposure of the view and the lens's falloff, which were found from
  the points that it shares with other pictures.
  """
  truth = views.images[index]
  if truth.shape[:2] != (height, width):
    truth = cv2.resize(truth, (width, height), interpolation=cv2.INTER_AREA)
  camera = views.camera.resized(width, height)
  image, depth = renderer.render(camera, views.world_from_camera[index])
  if views.exposure is not None:
    image = photometry.expose(image, views.exposure.factors(index, camera))
  return ViewScore(
    views.names[index],
    truth,
    image,
    depth,
    image_quality.psnr(truth, image),
    image_quality.ssim(truth, image),
  )


def evaluate(
  renderer: Renderer,
  views: Views,
  *,
  progress: Progress = no_progress,
) -> tuple[list[ViewScore], dict[str, float]]:
  """Scores all views at full and at robot resolution.

  Args:
    renderer: Draws the field.
    views: Held-out pictures with their poses in the field's frame.
    progress: Called with the fraction done and a text.

  Returns:
    The scores at full size, and the figures: medians would hide failures, so these are means.
  """
  count = len(views.names)
  full = []
  for index in range(count):
    full.append(compare(renderer, views, index, views.camera.height, views.camera.width))
    progress((index + 1) / (count + 1), f"view {index + 1} of {count}")
  figures = {
    "held_out_views": float(count),
    "held_out_psnr_db": float(np.mean([score.psnr_db for score in full])),
    "held_out_ssim": float(np.mean([score.ssim for score in full])),
  }
  for height, width in ROBOT_SIZES:
    scores = [compare(renderer, views, index, height, width) for index in range(count)]
    size = f"{height}x{width}"
    figures[f"held_out_psnr_{size}_db"] = float(np.mean([score.psnr_db for score in scores]))
    figures[f"held_out_ssim_{size}"] = float(np.mean([score.ssim for score in scores]))
  return full, figures


def save_scores(scores: Sequence[ViewScore], folder: Path) -> None:
  """Writes scores so that `load_scores` finds them."""
  np.savez(
    folder / "views.npz",
    truth=np.stack([score.truth for score in scores]),
    image=np.stack([score.image for score in scores]),
    depth=np.stack([score.depth for score in scores]).astype(np.float16),
  )
  rows = [{"name": s.name, "psnr_db": s.psnr_db, "ssim": s.ssim} for s in scores]
  write_json(folder / "views.json", rows)


def load_scores(folder: Path) -> list[ViewScore]:
  """Reads what `save_scores` wrote."""
  rows = json.loads((folder / "views.json").read_text())
  arrays = np.load(folder / "views.npz")
  truth, image, depth = arrays["truth"], arrays["image"], arrays["depth"].astype(np.float32)
  return [
    ViewScore(row["name"], truth[k], image[k], depth[k], row["psnr_db"], row["ssim"])
    for k, row in enumerate(rows)
  ]
