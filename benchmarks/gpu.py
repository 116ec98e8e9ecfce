"""Checks everything that has a GPU version, on a machine that has a GPU, in under ten minutes.

  render   the renderer on CUDA against the CPU's pictures, one at a time and in batches
  fused    training of the radiance field with the fused kernels at preset "fast": steps/s, PSNR
  field    the same in JAX at preset "paper"
  learner  updates/s of the agent at the paper's batch, 30x40 and 60x80 pictures

Each check is a process of its own with a time limit: one that fails or hangs loses no other's
figures. They are printed as they come; `--write` keeps them as records with the GPU's name. Exit
status: 0 if all went well or there is no GPU (one line is printed), 1 if a check failed.

  python benchmarks/gpu.py --write
  python benchmarks/gpu.py --device cpu --tiny      # a rehearsal of all checks without a GPU
"""

import dataclasses
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from benchmarks import compare, harness
from benchmarks.ledger import records as ledger
from benchmarks.ledger.records import ROOT, Value

Figures = dict[str, dict[str, Value]]
SIZES = ((30, 40), (60, 80))  # picture sizes [H, W] of the policies
# Names of the checks and their limits [s], together under ten minutes.
LIMITS = {"render": 110.0, "fused": 120.0, "field": 180.0, "learner": 170.0}
_LEAST_AGREEMENT_DB = 40.0  # of the device's picture with the CPU's: 2.6 of 255 levels RMS
_TINY_FIELD = {"levels": 2, "log2_table_size": 10, "width": 16}
_TINY_AGENT = ("batch_size=2", "trajectory_length=4", "n_step=2", "num_samples=2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to check."""

  device: Literal["cuda", "cpu"] = "cuda"
  """cpu rehearses the checks where there is no GPU."""
  tiny: bool = False
  """Small sizes: whether the checks run, not how fast."""
  only: tuple[Literal["render", "fused", "field", "learner"], ...] = ()
  """Checks to run; empty: all."""
  limit: float | None = None
  """Time limit of every check [s], if not its own."""
  seconds: float = 60.0
  """Training time of a field [s]."""
  check: Literal["render", "fused", "field"] | None = None
  """Run this check in this process and write its figures to --out; used by the command itself."""


def check_render(settings: Settings) -> Figures:
  """Compares pictures of the built-in room drawn on the device with the CPU's, and times both."""
  import numpy as np

  from nerf2real.core.geometry.cameras import Camera
  from nerf2real.core.geometry.similarity import Similarity
  from nerf2real.core.serialization import from_plain
  from nerf2real.scenes.builtin import ground_truth
  from nerf2real.scenes.bundle import Bundle
  from nerf2real.scenes.field.field import Field
  from nerf2real.scenes.field.render.renderer import Renderer
  from nerf2real.scenes.quality.image_quality import psnr

  bundle = Bundle.load()
  field = Field.load(bundle.field_path)
  cpu = Renderer(field)
  device = Renderer(field, device=settings.device, occupancy=cpu.occupancy)
  views, rounds, batches = (2, 2, (2,)) if settings.tiny else (24, 100, (16, 64, 256))
  arrays = np.load(ground_truth.ROBOT_VIEWS)
  room_from_world = from_plain(bundle.figures["room_from_world"], Similarity)
  room_from_unit = room_from_world @ bundle.world_from_unit
  poses = room_from_unit.inverse().apply_pose(arrays["world_from_camera"][:views])
  figures: Figures = {}
  for height, width in SIZES[: 1 if settings.tiny else None]:
    camera: Camera = ground_truth.robot_camera(height, width)
    expected = [cpu.render(camera, pose)[0] for pose in poses]
    found = [device.render(camera, pose)[0] for pose in poses]
    pairs = list(zip(found, expected, strict=True))
    agreement = [psnr(a, b) if (a != b).any() else 99.0 for a, b in pairs]
    row: dict[str, Value] = {
      "against_cpu_worst_db": float(min(agreement)),
      "largest_difference_levels": int(max(np.abs(a.astype(int) - b).max() for a, b in pairs)),
    }
    calls: dict[str, Callable[[int], None]] = {
      "single": functools.partial(_render_one, device, camera, poses)
    }
    for size in batches:
      many = poses[np.arange(size) % len(poses)]
      calls[f"batch_{size}"] = functools.partial(_render_batch, device, camera, many)
    times = harness.interleave(calls, rounds=rounds, warm_up=2, seconds=10.0)
    row["single_ms"] = times["single"].figures()["median_ms"]
    for size in batches:
      row[f"batch_of_{size}_a_picture_ms"] = times[f"batch_{size}"].figures(per=size)["median_ms"]
    figures[f"render_{height}x{width}"] = row
    if min(agreement) < _LEAST_AGREEMENT_DB:
      raise RuntimeError(
        f"{height}x{width}: found pictures {min(agreement):.1f} dB from the CPU's; expected at "
        f"least {_LEAST_AGREEMENT_DB:g} dB."
      )
  return figures


def _render_one(renderer: Any, camera: Any, poses: Any, index: int) -> None:
  renderer.render(camera, poses[index % len(poses)])


def _render_batch(renderer: Any, camera: Any, poses: Any, _: int) -> None:
  renderer.render_batch(camera, poses)


def check_fused(settings: Settings) -> Figures:
  """Trains a field with the fused kernels at preset "fast" on keyframes of the built-in room."""
  from benchmarks.rooms import field

  chosen = field.Settings(preset="fast", engine="fused", seconds=settings.seconds, keyframes=120)
  if settings.tiny:
    chosen = dataclasses.replace(chosen, seconds=2.0, keyframes=16, width=80)
  changes = {"device": settings.device}
  return {"field_fast": field.train(chosen, changes=changes, device=settings.device)}


def check_field(settings: Settings) -> Figures:
  """Trains a field in JAX at preset "paper" on keyframes of the built-in room."""
  import jax

  from benchmarks.rooms import field

  if settings.device == "cuda" and jax.default_backend() != "gpu":
    raise RuntimeError(f"JAX found {jax.default_backend()}, expected a GPU: install the extra gpu.")
  changes: dict[str, Any] = {}
  chosen = field.Settings(preset="paper", seconds=settings.seconds, keyframes=120)
  if settings.tiny:
    changes = {"field": _TINY_FIELD, "batch_rays": 64, "max_steps": 3}
    chosen = field.Settings(preset="paper", seconds=5.0, keyframes=16, width=80)
  return {"field_paper": field.train(chosen, changes=changes, device=settings.device)}


def commands(settings: Settings, out: Path) -> dict[str, list[str]]:
  """Returns the command of every check, which writes its figures to out/NAME.json."""
  chosen = ["--device", settings.device, "--seconds", str(settings.seconds)]
  chosen += ["--tiny"] if settings.tiny else []
  found = {
    name: [__file__, "--check", name, *chosen, "--out", str(out / f"{name}.json")]
    for name in ("render", "fused", "field")
  }
  sizes = [f"{height}x{width}" for height, width in SIZES[: 1 if settings.tiny else None]]
  changes = [word for change in _TINY_AGENT for word in ("--set", change)] if settings.tiny else []
  seconds = "0.1" if settings.tiny else "15"
  script = str(ROOT / "benchmarks" / "learning" / "learner.py")
  found["learner"] = [script, "--seconds", seconds, *changes]
  found["learner"] += ["--out", str(out / "learner.json"), "--pictures", *sizes]
  return {name: found[name] for name in LIMITS if not settings.only or name in settings.only}


def run_check(name: str, command: list[str], out: Path, *, limit: float, device: str) -> Figures:
  """Runs a check in a process of its own.

  Raises:
    RuntimeError: It fails, or takes longer than its limit.
  """
  # Warp and a second process need memory beside JAX.
  platforms = {"JAX_PLATFORMS": "cpu"} if device == "cpu" else {}
  platforms["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
  try:
    done = subprocess.run(
      [sys.executable, *command],
      env=os.environ | platforms,
      capture_output=True,
      text=True,
      timeout=limit,
    )
  except subprocess.TimeoutExpired:
    raise RuntimeError(f"took longer than {limit:g} s") from None
  if done.returncode:
    raise RuntimeError(compare.last_error(done))
  figures = json.loads((out / f"{name}.json").read_text())["figures"]
  prefix = "" if name != "learner" else "learner_paper_"
  return {f"{prefix}{row}": values for row, values in figures.items()}


def main(settings: Settings) -> int:
  """Runs all checks; returns 1 if one failed."""
  if settings.check is not None:
    checks = {"render": check_render, "fused": check_fused, "field": check_field}
    figures = checks[settings.check](settings)
    harness.finish("gpu", figures, settings, seed=0)
    return 0
  machine = harness.machine()
  if settings.device == "cuda" and not machine.gpu:
    print(f"No GPU was found on this machine ({machine}): nothing to check.")
    return 0
  failed: dict[str, str] = {}
  everything: Figures = {}
  prefix = ledger.slug(machine.gpu if settings.device == "cuda" else f"cpu {machine.cpu}")
  with tempfile.TemporaryDirectory() as folder:
    for name, command in commands(settings, Path(folder)).items():
      begin = time.perf_counter()
      limit = settings.limit or LIMITS[name]
      try:
        found = run_check(name, command, Path(folder), limit=limit, device=settings.device)
        everything |= {f"{prefix}_{row}": values for row, values in found.items()}
        print(f"{name}: done in {time.perf_counter() - begin:.0f} s", flush=True)
      except RuntimeError as error:
        failed[name] = str(error)
        print(f"{name}: FAILED: {error}", flush=True)
  words = "; ".join(f"{name} failed: {error}" for name, error in failed.items())
  harness.finish("gpu", everything, settings, seed=0, words=words, within="speed")
  return 1 if failed else 0


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
