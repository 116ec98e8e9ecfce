"""Environment steps a second on one core, next to dm_control's own humanoid with pixels.

The variants take turns within one run, so that they see the same machine. Steps include the resets
of episodes that end. Where other work shares the core, the figures by processor time are the ones
to read: steps/s by processor time is what a core does that is not shared. The humanoid is measured
twice: as dm_control draws it, and with shadows and multisampling off, which software GL is slow at.

  python benchmarks/simulation/env.py [--scene out/livingroom] [--out figures.json] [--other DIR]
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and dm_control are imported)

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

from benchmarks import harness

harness.one_thread()

import numpy as np
from dm_control import suite as dm_suite

from nerf2real import suite
from nerf2real.suite import loading
from nerf2real.suite.scene import open_scene
from nerf2real.suite.sensors.camera import world_from_camera

SIZES = ((30, 40), (60, 80))
_RESETS = 3  # timed after every turn
_PARTS = 100  # repetitions of a part of a picture


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
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


class Variant:
  """One environment that is stepped with small motions about its standing pose."""

  def __init__(self, reset: Callable[[], Any], step: Callable[[Any], Any], size: int):
    self._reset, self._step, self._size = reset, step, size
    self._rng = np.random.default_rng(0)
    self.center = np.zeros(size)
    self._reset()

  def turn(self, steps: int, _: int) -> None:
    """Takes some steps, and the resets that they need."""
    actions = np.clip(self.center + self._rng.normal(0, 0.15, (steps, self._size)), -1, 1)
    for action in actions:
      if self._step(action.astype(np.float32)).last():
        self._reset()

  def resets(self, _: int) -> None:
    """Resets some times."""
    for _ in range(_RESETS):
      self._reset()


def robot_variant(settings: Settings, bundle: Any, **options: Any) -> Variant:
  """Returns a variant of the project's environment."""
  environment = suite.load(settings.task, scene=bundle, random=1, **options)
  variant = Variant(environment.reset, environment.step, environment.action_spec().shape[0])
  variant.center = environment.task.standing_action
  variant.environment = environment  # type: ignore[attr-defined]
  return variant


def humanoid_variant(*, fast: bool) -> Variant:
  """Returns dm_control's humanoid with a 30x40 picture a step; fast: no shadows, multisampling."""
  environment = dm_suite.load("humanoid", "walk", task_kwargs={"random": 1})
  if fast:
    quality = environment.physics.model.vis.quality
    quality.shadowsize = quality.offsamples = 0

  def step(action: np.ndarray) -> Any:
    timestep = environment.step(action)
    environment.physics.render(30, 40, camera_id=0)
    return timestep

  return Variant(environment.reset, step, environment.action_spec().shape[0])


def picture_parts(variant: Variant) -> dict[str, float]:
  """Returns what a picture is made of, processor time [ms]."""
  environment = variant.environment  # type: ignore[attr-defined]
  camera, data = environment.task.robot_camera, environment.physics.data.ptr
  pose = world_from_camera(data, camera.camera_id)
  times = harness.interleave(
    {
      "whole": lambda _: camera.render(data),
      "field": lambda _: camera.render_field(pose),
      "geoms_by_ray": lambda _: camera.caster.cast(data, pose),
    },
    rounds=_PARTS,
  )
  return {f"{name}_ms": t.figures()["processor_median_ms"] for name, t in times.items()}


def main(settings: Settings) -> None:
  """Runs the benchmark."""
  harness.one_core()
  bundle = open_scene(settings.scene)
  renderer = loading.load_renderer(bundle)
  variants = {
    f"{settings.task}_{h}x{w}": robot_variant(
      settings, bundle, image_size=(h, w), renderer=renderer
    )
    for h, w in SIZES
  }
  variants[f"{settings.task}_no_camera"] = robot_variant(settings, bundle, image_size=None)
  if settings.humanoid:
    variants["humanoid_30x40"] = humanoid_variant(fast=False)
    variants["humanoid_30x40_plain"] = humanoid_variant(fast=True)
  calls: dict[str, Callable[[int], None]] = {}
  for name, variant in variants.items():
    calls[name] = functools.partial(variant.turn, settings.steps)
    calls[f"{name} reset"] = variant.resets
  times = harness.interleave(calls, rounds=settings.rounds)
  figures: dict[str, dict[str, harness.Value]] = {}
  for name in variants:
    steps = times[name].figures(per=settings.steps)
    figures[name] = {
      "steps_per_s": times[name].rate(per=settings.steps),
      "steps_per_s_by_processor_time": 1e3 / steps["processor_median_ms"],
      **steps,
      "reset_processor_ms": times[f"{name} reset"].figures(per=_RESETS)["processor_median_ms"],
    }
  for height, width in SIZES:
    parts = picture_parts(variants[f"{settings.task}_{height}x{width}"])
    figures[f"picture_{height}x{width}"] = dict(parts)
  harness.finish("env", figures, settings, seed=1)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
