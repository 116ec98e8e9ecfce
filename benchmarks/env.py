"""Environment steps a second on one core, next to dm_control's own humanoid with pixels.

The variants take turns within one run, so that they see the same machine. Steps include the resets
of episodes that end. Where other work shares the core, the figures by processor time are the ones
to read: steps/s by processor time is what a core does that is not shared. The humanoid is measured
twice: as dm_control draws it, and with shadows and multisampling off, which software GL is slow at.

  python benchmarks/env.py [--scene out/livingroom] [--output benchmarks/results/env_x.json]
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and dm_control are imported)

import dataclasses
import datetime
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
  os.environ.setdefault(_name, "1")
os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import tyro
from dm_control import suite as dm_suite

from nerf2real import suite
from nerf2real.suite import loading
from nerf2real.suite.sensors.camera import world_from_camera

SIZES = ((30, 40), (60, 80))
_RESETS = 3  # timed after every turn


@dataclasses.dataclass(frozen=True)
class Settings:
  """Settings of the benchmark."""

  scene: str | None = None
  """Folder of a scene bundle; the built-in room if not given."""
  task: str = "nerf_nav"
  """Task."""
  rounds: int = 10
  """Turns of every variant."""
  steps: int = 40
  """Steps in a turn."""
  humanoid: bool = True
  """Whether to measure dm_control's humanoid too (needs GL)."""
  output: Path | None = None
  """Where to write the figures, as JSON."""


class Variant:
  """One environment that is stepped with small motions about its standing pose."""

  def __init__(self, name: str, reset: Callable[[], Any], step: Callable[[Any], Any], size: int):
    self.name, self._reset, self._step, self._size = name, reset, step, size
    self._rng = np.random.default_rng(0)
    self.center = np.zeros(size)
    self.turns: list[float] = []  # s a step
    self.cpu: list[float] = []  # s of processor time a step
    self.resets: list[float] = []  # s of processor time
    self._timed_reset()

  def _timed_reset(self) -> None:
    begin = time.process_time()
    self._reset()
    self.resets.append(time.process_time() - begin)

  def turn(self, steps: int) -> None:
    """Takes some steps and notes the mean time."""
    actions = np.clip(self.center + self._rng.normal(0, 0.15, (steps, self._size)), -1, 1)
    begin, begin_cpu = time.perf_counter(), time.process_time()
    for action in actions:
      if self._step(action.astype(np.float32)).last():
        self._timed_reset()
    self.turns.append((time.perf_counter() - begin) / steps)
    self.cpu.append((time.process_time() - begin_cpu) / steps)
    for _ in range(_RESETS):
      self._timed_reset()


def robot_variant(name: str, settings: Settings, bundle: Any, **options: Any) -> Variant:
  """Returns a variant of the project's environment."""
  environment = suite.load(settings.task, scene=bundle, random=1, **options)
  variant = Variant(name, environment.reset, environment.step, environment.action_spec().shape[0])
  variant.center = environment.task.standing_action
  variant.environment = environment  # type: ignore[attr-defined]
  return variant


def humanoid_variant(name: str, *, fast: bool) -> Variant:
  """Returns dm_control's humanoid with a 30x40 picture a step.

  Args:
    name: Name of the variant.
    fast: Whether to draw without shadows and multisampling.
  """
  environment = dm_suite.load("humanoid", "walk", task_kwargs={"random": 1})
  if fast:
    quality = environment.physics.model.vis.quality
    quality.shadowsize = quality.offsamples = 0

  def step(action: np.ndarray) -> Any:
    timestep = environment.step(action)
    environment.physics.render(30, 40, camera_id=0)
    return timestep

  return Variant(name, environment.reset, step, environment.action_spec().shape[0])


def processor() -> str:
  """Returns the processor's name."""
  for line in Path("/proc/cpuinfo").read_text().splitlines():
    if line.startswith("model name"):
      return line.split(":", 1)[1].strip()
  return "unknown"


def summary(variant: Variant) -> dict[str, float]:
  """Returns a variant's figures."""
  turns, cpu = 1e3 * np.array(variant.turns), 1e3 * np.array(variant.cpu)
  return {
    "steps_per_s": round(1e3 / float(turns.mean()), 1),
    "steps_per_s_by_processor_time": round(1e3 / float(np.median(cpu)), 1),
    "median_ms": round(float(np.median(turns)), 3),
    "worst_turn_ms": round(float(turns.max()), 3),
    "processor_median_ms": round(float(np.median(cpu)), 3),
    "processor_best_turn_ms": round(float(cpu.min()), 3),
    "reset_processor_ms": round(1e3 * float(np.median(variant.resets)), 2),
  }


def measure(call: Callable[[], Any], count: int = 100) -> float:
  """Returns the median processor time of a call [ms]."""
  times = []
  for _ in range(count):
    begin = time.process_time()
    call()
    times.append(time.process_time() - begin)
  return 1e3 * float(np.median(times))


def picture_parts(variant: Variant) -> dict[str, float]:
  """Returns what a picture is made of, processor time [ms]."""
  environment = variant.environment  # type: ignore[attr-defined]
  camera, data = environment.task.robot_camera, environment.physics.data.ptr
  pose = world_from_camera(data, camera.camera_id)
  return {
    "whole": round(measure(lambda: camera.render(data)), 3),
    "field": round(measure(lambda: camera.render_field(pose)), 3),
    "geoms_by_ray": round(measure(lambda: camera.caster.cast(data, pose)), 3),
  }


def main(settings: Settings) -> None:
  """Runs the benchmark."""
  os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[0]})
  bundle = loading.open_scene(settings.scene)
  renderer = loading.load_renderer(bundle)
  variants = [
    robot_variant(
      f"{settings.task}, {h}x{w}", settings, bundle, image_size=(h, w), renderer=renderer
    )
    for h, w in SIZES
  ]
  variants.append(robot_variant(f"{settings.task}, no camera", settings, bundle, image_size=None))
  if settings.humanoid:
    variants.append(humanoid_variant("dm_control humanoid, 30x40", fast=False))
    variants.append(humanoid_variant("the same, plain drawing", fast=True))
  for variant in variants:
    variant.turn(5)
    variant.turns.clear()
    variant.cpu.clear()
    variant.resets.clear()
  load = [os.getloadavg()[0]]
  for _ in range(settings.rounds):
    for variant in variants:
      variant.turn(settings.steps)
  load.append(os.getloadavg()[0])
  figures = {variant.name: summary(variant) for variant in variants}
  pictures = {
    f"{h}x{w}": picture_parts(variant) for variant, (h, w) in zip(variants, SIZES, strict=False)
  }
  print(
    f"{processor()}, one core, {settings.rounds} turns of {settings.steps} steps; "
    f"load of the machine {load[0]:.1f} to {load[1]:.1f}"
  )
  print(
    f"{'':28s}{'steps/s':>9s}{'by CPU time':>13s}{'median ms':>11s}{'CPU ms':>9s}"
    f"{'reset CPU ms':>14s}"
  )
  for name, row in figures.items():
    print(
      f"{name:28s}{row['steps_per_s']:9.0f}{row['steps_per_s_by_processor_time']:13.0f}"
      f"{row['median_ms']:11.2f}{row['processor_median_ms']:9.2f}"
      f"{row['reset_processor_ms']:14.2f}"
    )
  for size, parts in pictures.items():
    listed = ", ".join(f"{name.replace('_', ' ')} {value:.2f}" for name, value in parts.items())
    print(f"{size} picture, CPU ms: {listed}")
  if settings.output is not None:
    settings.output.parent.mkdir(parents=True, exist_ok=True)
    content = {
      "processor": processor(),
      "cores_used": 1,
      "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
      "load_average": [round(value, 1) for value in load],
      "scene": str(settings.scene or "the built-in room"),
      "task": settings.task,
      "turns": settings.rounds,
      "steps_a_turn": settings.steps,
      "variants": figures,
      "picture_processor_ms": pictures,
    }
    settings.output.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
  main(tyro.cli(Settings))
