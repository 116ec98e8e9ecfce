"""Steps and rays a second of the field's training on the film of the built-in room.

Keyframes at their true poses, preset "fast"; compilation is not counted.

  python benchmarks/rooms/field.py --other ../before --turns 3
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks import harness
from benchmarks.rooms import blur_ablation
from nerf2real.scenes.field import training
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.quality.image_quality import psnr


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to train."""

  seconds: float = 20.0
  """Training time [s]."""
  keyframes: int = 40
  """Pictures of the film."""
  width: int = 640
  """Their width [pixel]."""
  preset: str = "fast"
  """Preset of the training."""
  engine: str = ""
  """Engine, if not the preset's."""
  seed: int = 0
  """Of the training."""


def train(
  settings: Settings, *, changes: Mapping[str, Any] | None = None, device: str | None = None
) -> dict[str, harness.Value]:
  """Trains once; returns rates, and the score of held-out pictures where they are drawn.

  Args:
    settings: What to train.
    changes: Settings that differ from the preset's, those of the field under "field".
    device: Of the renderer that draws held-out pictures; none are drawn if None.
  """
  film = blur_ablation.Settings(keyframes=settings.keyframes, width=settings.width)
  views, held_out = blur_ablation.film_views(film).split()
  chosen = training.preset(settings.preset)
  others = dict(changes or {})
  shape = dataclasses.replace(chosen.field, **others.pop("field", {}))
  others |= {"engine": settings.engine} if settings.engine else {}
  chosen = dataclasses.replace(chosen, field=shape, max_seconds=settings.seconds, **others)
  field, report = training.train(views, chosen, seed=settings.seed)
  figures: dict[str, harness.Value] = {
    "steps_per_s": report.steps / report.seconds,
    "rays_per_s": report.rays / report.seconds,
    "samples_per_s": report.samples / report.seconds,
    "steps": report.steps,
    "training_s": report.seconds,
    "training_psnr_db": report.curve_psnr_db[-1] if report.curve_psnr_db else float("nan"),
  }
  if device is not None:
    renderer = Renderer(field, device=device)
    pictures, _ = renderer.render_batch(held_out.camera, held_out.world_from_camera)
    scores = [psnr(drawn, true) for drawn, true in zip(pictures, held_out.images, strict=True)]
    figures |= {"held_out_psnr_db": float(np.mean(scores)), "held_out_views": len(held_out)}
  return figures


def main(settings: Settings) -> None:
  """Trains and prints the table."""
  harness.finish("field", {settings.preset: train(settings)}, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
