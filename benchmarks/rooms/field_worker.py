"""Trains a radiance field in the checkout that PYTHONPATH names, and prints figures as JSON.

The process that `field.py` beside this and `benchmarks/gpu.py` start. It imports nothing of these
folders, so that it measures older commits too: where a checkout keeps its trainer is an argument.

  PYTHONPATH=/checkout python benchmarks/rooms/field_worker.py --views views.npz --seconds 20
    --training nerf2real.scenes.field.training --views-module nerf2real.scenes.field.views
    --cameras nerf2real.core.cameras
"""

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import tyro

_HELD_OUT_EVERY = 8  # as LLFF does


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
  """What to train."""

  views: Path
  """File of pictures and poses, see `save_views`."""
  seconds: float
  """Training time, compilation not counted."""
  preset: str = "fast"
  """Preset of the training."""
  engine: str = ""
  """Engine, if not the preset's."""
  changes: str = "{}"
  """Settings that differ from the preset's: JSON, those of the field under "field"."""
  seed: int = 0
  """Of parameters and rays."""
  training: str = "nerf2real.scenes.field.training"
  """Module with train and preset."""
  views_module: str = "nerf2real.scenes.field.views"
  """Module with Views."""
  cameras: str = "nerf2real.core.cameras"
  """Module with Camera."""
  renderer: str = ""
  """Module with Renderer and its device after a colon: also score held-out pictures."""
  save: Path | None = None
  """Where to keep the trained field."""


def save_views(path: Path, views: Any) -> None:
  """Writes pictures, poses and camera of `Views` as a file that every checkout reads."""
  camera = json.dumps(dataclasses.asdict(views.camera))
  np.savez(path, images=views.images, poses=views.world_from_camera, camera=camera)


def load_views(settings: Settings) -> Any:
  """Returns the file's `Views` as the checkout's own class."""
  arrays = np.load(settings.views)
  camera_type = importlib.import_module(settings.cameras).Camera
  fields = {field.name for field in dataclasses.fields(camera_type)}
  known = json.loads(str(arrays["camera"]))
  camera = camera_type(**{name: value for name, value in known.items() if name in fields})
  names = tuple(f"{index:05d}" for index in range(len(arrays["images"])))
  views = importlib.import_module(settings.views_module).Views
  return views(camera, arrays["images"], arrays["poses"], names)


def held_out_psnr(settings: Settings, field: Any, views: Any) -> dict[str, float]:
  """Returns the mean PSNR [dB] of held-out pictures, drawn by the checkout's renderer."""
  module, _, device = settings.renderer.partition(":")
  renderer = importlib.import_module(module).Renderer(field, device=device or "cpu")
  pictures, _ = renderer.render_batch(views.camera, views.world_from_camera)
  error = pictures.astype(np.float64) - views.images
  square = np.mean((error / 255) ** 2, axis=(1, 2, 3))
  return {"held_out_psnr_db": float(np.mean(-10 * np.log10(square))), "held_out_views": len(views)}


def main(settings: Settings) -> None:
  """Trains, prints one line of JSON."""
  training = importlib.import_module(settings.training)
  views, held_out = load_views(settings).split(_HELD_OUT_EVERY)
  chosen = training.preset(settings.preset)
  changes = json.loads(settings.changes)
  shape = dataclasses.replace(chosen.field, **changes.pop("field", {}))
  engine = {"engine": settings.engine} if settings.engine else {}
  chosen = dataclasses.replace(
    chosen, field=shape, max_seconds=settings.seconds, **engine, **changes
  )
  field, report = training.train(views, chosen, seed=settings.seed)
  if settings.save is not None:
    field.save(settings.save)
  figures = {
    "steps_per_s": report.steps / report.seconds,
    "rays_per_s": report.rays / report.seconds,
    "samples_per_s": report.samples / report.seconds,
    "steps": report.steps,
    "training_s": report.seconds,
    "training_psnr_db": report.curve_psnr_db[-1] if report.curve_psnr_db else float("nan"),
  }
  if settings.renderer:
    figures |= held_out_psnr(settings, field, held_out)
  print(json.dumps(figures))


if __name__ == "__main__":
  main(tyro.cli(Settings, description=__doc__))
