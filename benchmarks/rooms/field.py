"""Steps and rays a second of the field's training, here and in another checkout in turn.

Keyframes of the built-in room's film at their true poses, preset "fast". Every turn is a process of
its own (`field_worker.py` beside this), so that two commits can be measured side by side whatever
they call their modules.

  python benchmarks/rooms/field.py --other ../before --turns 3
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks import compare, harness
from benchmarks.ledger.records import ROOT
from benchmarks.rooms import blur_ablation
from benchmarks.rooms.field_worker import save_views

WORKER = Path(__file__).with_name("field_worker.py")
# Where a checkout keeps its trainer: a file that shows the layout, then the worker's arguments.
LAYOUTS = {
  "nerf2real/scenes/field/training.py": {},
  "scenes/train.py": {
    "training": "scenes.train",
    "views-module": "scenes.views",
    "cameras": "scenes.cameras",
  },
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to train."""

  seconds: float = 20.0
  """Training time of a turn [s]."""
  turns: int = 3
  """Trainings in each checkout."""
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


def layout(checkout: Path) -> dict[str, str]:
  """Returns the worker's arguments for where a checkout keeps its trainer.

  Raises:
    ValueError: The checkout has none of the known layouts.
  """
  for path, modules in LAYOUTS.items():
    if (checkout / path).is_file():
      return modules
  raise ValueError(f"Found none of {', '.join(LAYOUTS)} in {checkout}; add its layout to LAYOUTS.")


def train(
  checkout: Path, arguments: dict[str, object], *, timeout: float | None = None
) -> dict[str, float]:
  """Trains once in a process of its own; returns the worker's figures.

  Raises:
    RuntimeError: The worker fails.
  """
  options = {**layout(checkout), **arguments}
  words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
  done = subprocess.run(
    [sys.executable, str(WORKER), *words],
    env=os.environ | {"PYTHONPATH": str(checkout)},
    capture_output=True,
    text=True,
    timeout=timeout,
  )
  if done.returncode:
    raise RuntimeError(f"training in {checkout} failed: {compare.last_error(done)}")
  return json.loads(done.stdout.splitlines()[-1])


def summary(runs: list[dict[str, float]]) -> dict[str, harness.Value]:
  """Returns the median and the slowest of rates over the turns."""
  figures: dict[str, harness.Value] = {}
  for name in ("steps_per_s", "rays_per_s", "samples_per_s"):
    values = [run[name] for run in runs]
    figures[name] = harness.percentile(values, 50)
    figures[f"slowest_{name}"] = min(values)
  figures["training_psnr_db"] = harness.percentile([r["training_psnr_db"] for r in runs], 50)
  return figures


def main(settings: Settings) -> None:
  """Trains in turns and prints the table."""
  checkouts = {"here": ROOT} | ({"other": settings.other.resolve()} if settings.other else {})
  for checkout in checkouts.values():
    layout(checkout)  # fails before anything takes long
  runs: dict[str, list[dict[str, float]]] = {name: [] for name in checkouts}
  with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "views.npz"
    film = blur_ablation.Settings(keyframes=settings.keyframes, width=settings.width)
    save_views(path, blur_ablation.film_views(film))
    arguments: dict[str, object] = {
      "views": path,
      "seconds": settings.seconds,
      "preset": settings.preset,
      "seed": settings.seed,
      **({"engine": settings.engine} if settings.engine else {}),
    }
    for turn in range(settings.turns):
      for name in list(checkouts)[:: 1 if turn % 2 == 0 else -1]:
        runs[name].append(train(checkouts[name], arguments))
  figures = {f"{settings.preset}_{name}": summary(found) for name, found in runs.items()}
  words = ""
  if "other" in runs:
    names = ("steps_per_s", "rays_per_s", "samples_per_s")
    medians = {side: summary(found) for side, found in runs.items()}
    ratios = (f"{n} {float(medians['here'][n]) / float(medians['other'][n]):.3f}" for n in names)  # type: ignore[arg-type]
    words = f"here over other ({settings.other}): {', '.join(ratios)}"
  if settings.write:  # the other checkout's figures are not this commit's
    figures.pop(f"{settings.preset}_other", None)
  harness.finish("field", figures, settings, seed=settings.seed, words=words)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__, compares=False)
