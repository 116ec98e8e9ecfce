"""Trains a radiance field on posed pictures; can be interrupted and continued.

Two engines do the steps: the fused Warp kernels (`engine`), and JAX as the reference, which is the
paper's recipe with proposal sampling (`reference_training`). Both train the same field and write
the same file.
"""

import dataclasses
import hashlib
import json
import math
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import safetensors.numpy

from nerf2real.core import files
from nerf2real.core.progress import Progress, no_progress
from nerf2real.core.serialization import to_plain
from nerf2real.scenes.field.engine.trainer import FusedTrainer
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.reference_training import ReferenceTrainer
from nerf2real.scenes.field.settings import TrainSettings, preset
from nerf2real.scenes.field.views import Views

__all__ = ["TrainError", "TrainReport", "TrainSettings", "learning_rate", "preset", "train"]

CHECKPOINT_SECONDS = 60.0  # chosen: a checkpoint takes about 0.2 s
_RECORD_SECONDS = 2.0  # chosen: distance of the points of the report's curve
SNAPSHOT_SECONDS = 5.0  # chosen: often enough to see it grow
_WARMUP_START = 0.01  # the warm-up starts at this fraction of the learning rate, as in multinerf
_CHECKPOINT = "training.safetensors"
_CHECKPOINT_FORMAT = "3"  # 3: with a hash of the arrays; files that name none have format 1


class TrainError(ValueError):
  """Training cannot start or go on; the message is one line for the user."""


@dataclasses.dataclass(frozen=True)
class TrainReport:
  """What a training run did. Curves have one entry for every point in `curve_seconds`."""

  steps: int
  """Steps made, interrupted runs included."""
  seconds: float
  """Time spent, interrupted runs included, compilation not."""
  rays: int
  """Rays seen."""
  samples: int
  """Samples of the field evaluated."""
  samples_per_second: float
  engine: str
  curve_seconds: list[float]
  curve_psnr_db: list[float]
  """Of training rays, blurred ones included."""
  curve_samples_per_ray: list[float]
  resumed_at_step: int | None
  """Step of the checkpoint that the run continued, or None."""


class Snapshot(NamedTuple):
  """A field while it is trained."""

  field: Field
  step: int
  psnr_db: float  # of training rays
  seconds_left: float


class Trainer(Protocol):
  """An engine."""

  rays_done: int
  samples_done: int

  @property
  def steps_done(self) -> int: ...
  def prepare(self) -> None: ...
  def step(self, learning_rate: float) -> dict[str, float]: ...
  def field(self) -> Field: ...
  def state(self) -> dict[str, np.ndarray]: ...
  def restore(self, arrays: dict[str, np.ndarray]) -> None: ...


def learning_rate(settings: TrainSettings, fraction: float, step: int) -> float:
  """Learning rate after `fraction` of the training: linear warm-up, then exponential decay.

  Source: NeRF2Real, NeRF table (2e-3 to 4e-5, warm-up 2048 steps); form as in multinerf.
  """
  ratio = settings.final_learning_rate / settings.learning_rate
  rate = settings.learning_rate * ratio ** min(max(fraction, 0.0), 1.0)
  if step < settings.warmup_steps:
    rise = (step + 1) / settings.warmup_steps
    rate *= _WARMUP_START + (1 - _WARMUP_START) * rise
  return rate


def train(
  views: Views,
  settings: TrainSettings | None = None,
  *,
  progress: Progress = no_progress,
  seed: int = 0,
  checkpoint_dir: str | Path | None = None,
  initial: Field | None = None,
  show: Callable[[Snapshot], None] | None = None,
  show_period: float = SNAPSHOT_SECONDS,
) -> tuple[Field, TrainReport]:
  """Trains a field.

  Args:
    views: Training pictures with poses in the unit frame; no held-out ones.
    settings: How to train; the preset "fast" if None.
    progress: Called with the fraction done and a text.
    seed: Of the parameters and of the rays. With the same number of threads and steps the fused
      engine repeats a run exactly; a limit in seconds makes the number of steps vary.
    checkpoint_dir: Folder for a checkpoint a minute; training continues from one that is there.
    initial: A field to start from.
    show: Called with the field at times, such as to draw it.
    show_period: Between these times [s].

  Returns:
    The trained field and a report.

  Raises:
    TrainError: Too few pictures, a loss that is not finite, or a field that stays empty.
  """
  settings = settings or preset("fast")
  if len(views) < 3:
    raise TrainError(
      f"Found {len(views)} training pictures; a field needs at least 3, and a room about 100."
    )
  trainer: Trainer
  if settings.engine == "fused":
    trainer = FusedTrainer(views, settings, seed=seed, initial=initial, device=settings.device)
  else:
    trainer = ReferenceTrainer(views, settings, seed=seed, initial=initial)
  checkpoint = Path(checkpoint_dir) / _CHECKPOINT if checkpoint_dir is not None else None
  key = _run_key(views, settings, seed, initial)
  spent, resumed = 0.0, None
  if checkpoint is not None:
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    found = _load_checkpoint(checkpoint, key)
    if found is not None:
      spent, arrays = found
      trainer.restore(arrays)
      resumed = trainer.steps_done
  progress(0.0, "compiling the training kernels")
  trainer.prepare()

  curve: list[tuple[float, float, float]] = []
  start = last_checkpoint = time.monotonic()
  last_record, last_snapshot = -math.inf, start
  while True:
    seconds = spent + time.monotonic() - start
    fraction = settings.fraction_done(trainer.steps_done, seconds)
    if fraction >= 1.0 and trainer.steps_done > 0:
      break
    rate = learning_rate(settings, fraction, trainer.steps_done)
    metrics = trainer.step(rate)
    _check(metrics, trainer.steps_done, rate)
    now = time.monotonic()
    if now - last_record >= _RECORD_SECONDS:
      last_record = now
      per_ray = metrics["samples"] / max(metrics["rays"], 1)
      curve.append((spent + now - start, metrics["psnr_db"], per_ray))
      progress(fraction, f"step {trainer.steps_done}, {metrics['psnr_db']:.1f} dB on training rays")
    if show is not None and now - last_snapshot >= show_period:
      last_snapshot = now
      left = (spent + now - start) * (1 / max(fraction, 1e-6) - 1)
      show(Snapshot(trainer.field(), trainer.steps_done, metrics["psnr_db"], left))
    if checkpoint is not None and now - last_checkpoint >= CHECKPOINT_SECONDS:
      last_checkpoint = now
      _save_checkpoint(checkpoint, key, spent + now - start, trainer.state())

  field = trainer.field()
  if not all(np.isfinite(value).all() for value in field.params.values()):
    raise TrainError(_not_finite("a parameter", trainer.steps_done, 0.0))
  seconds = spent + time.monotonic() - start
  return field, TrainReport(
    steps=trainer.steps_done,
    seconds=seconds,
    rays=trainer.rays_done,
    samples=trainer.samples_done,
    samples_per_second=trainer.samples_done / max(seconds, 1e-9),
    engine=settings.engine,
    curve_seconds=[round(point[0], 2) for point in curve],
    curve_psnr_db=[round(point[1], 3) for point in curve],
    curve_samples_per_ray=[round(point[2], 2) for point in curve],
    resumed_at_step=resumed,
  )


def _check(metrics: dict[str, float], step: int, rate: float) -> None:
  for name in ("charbonnier", "distortion"):
    if not math.isfinite(metrics[name]):
      raise TrainError(_not_finite(f"the {name} loss", step, rate))


def _not_finite(what: str, step: int, rate: float) -> str:
  return (
    f"Training failed at step {step}: {what} is not finite (learning rate {rate:.2g}). Look for "
    "wrong poses among the pictures, or lower learning_rate and start again without the checkpoint."
  )


def _run_key(views: Views, settings: TrainSettings, seed: int, initial: Field | None) -> str:
  """Hash of all that a checkpoint depends on."""
  digest = hashlib.sha256(json.dumps(to_plain(settings), sort_keys=True).encode())
  about = [to_plain(views.camera), list(views.names), views.uneven, seed]
  digest.update(json.dumps(about).encode())
  for array in (views.world_from_camera, views.images, views.anchors):
    digest.update(np.ascontiguousarray(array).tobytes())
  if initial is not None:
    digest.update(_hash_arrays(initial.params).encode())
  return digest.hexdigest()


def _save_checkpoint(path: Path, key: str, seconds: float, arrays: dict[str, np.ndarray]) -> None:
  metadata = {
    "format": _CHECKPOINT_FORMAT,
    "key": key,
    "seconds": repr(seconds),
    "sha256": _hash_arrays(arrays),
  }
  files.write_atomically(path, safetensors.numpy.save(arrays, metadata=metadata))


def _hash_arrays(arrays: dict[str, np.ndarray]) -> str:
  """Hash of names and contents."""
  digest = hashlib.sha256()
  for name in sorted(arrays):
    digest.update(name.encode())
    digest.update(np.ascontiguousarray(arrays[name]).tobytes())
  return digest.hexdigest()


def _load_checkpoint(path: Path, key: str) -> tuple[float, dict[str, np.ndarray]] | None:
  """Returns the seconds and arrays of a checkpoint of this very run, or None."""
  if not path.exists():
    return None
  try:
    with safetensors.safe_open(path, "numpy") as file:
      metadata = file.metadata() or {}
      if (found := metadata.get("format", "1")) != _CHECKPOINT_FORMAT:
        _warn_unused(f"{path} is of format {found}, expected {_CHECKPOINT_FORMAT}")
        return None
      if metadata.get("key") != key:
        return None
      arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
  except (safetensors.SafetensorError, UnicodeDecodeError) as error:
    _warn_unused(f"{path} is damaged, as by a full disk or a crash ({error})")
    return None
  if _hash_arrays(arrays) != metadata.get("sha256"):
    _warn_unused(f"{path} is damaged: its arrays are not those that were written")
    return None
  return float(metadata["seconds"]), arrays


def _warn_unused(why: str) -> None:
  """Warns of a checkpoint that is of no use."""
  warnings.warn(
    f"{why}: training starts from the beginning and writes the checkpoint anew.", stacklevel=4
  )
