"""Environment steps a second on one core, next to dm_control's own humanoid with pixels.

The variants take turns within one run, so that they see the same machine. Steps include the resets
of episodes that end. Where other work shares the core, the column of processor time is the one to
read: 1000 / CPU ms is what the core alone would do.

  python benchmarks/env.py [--scene out/livingroom]
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and dm_control are imported)

import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
  os.environ.setdefault(_name, "1")
os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import tyro
from dm_control import suite as dm_suite

import suite
from suite import loading
from suite.camera import world_from_camera

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


class Variant:
  """One environment that is stepped with small motions about its standing pose."""

  def __init__(self, name: str, reset: Callable[[], Any], step: Callable[[Any], Any], size: int):
    self.name, self._reset, self._step, self._size = name, reset, step, size
    self._rng = np.random.default_rng(0)
    self.center = np.zeros(size)
    self.turns: list[float] = []  # s a step
    self.cpu: list[float] = []  # s of processor time a step
    self.resets: list[float] = []  # s
    self._timed_reset()

  def _timed_reset(self) -> None:
    begin = time.perf_counter()
    self._reset()
    self.resets.append(time.perf_counter() - begin)

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


def humanoid_variant() -> Variant:
  """Returns dm_control's humanoid with a 30x40 picture a step."""
  environment = dm_suite.load("humanoid", "walk", task_kwargs={"random": 1})

  def step(action: np.ndarray) -> Any:
    timestep = environment.step(action)
    environment.physics.render(30, 40, camera_id=0)
    return timestep

  return Variant("dm_control humanoid, 30x40", environment.reset, step,
                 environment.action_spec().shape[0])  # fmt: skip


def measure(call: Callable[[], Any], count: int = 100) -> float:
  """Returns the median time of a call [ms]."""
  times = []
  for _ in range(count):
    begin = time.perf_counter()
    call()
    times.append(time.perf_counter() - begin)
  return 1e3 * float(np.median(times))


def print_parts(variant: Variant, size: tuple[int, int], gl: bool) -> None:
  """Prints what a picture is made of."""
  environment = variant.environment  # type: ignore[attr-defined]
  task, physics = environment.task, environment.physics
  camera, data = task.robot_camera, physics.data.ptr
  pose = world_from_camera(data, camera.camera_id)
  print(f"\n{size[0]}x{size[1]} picture [ms]: whole {measure(lambda: camera.render(data)):.2f}, "
        f"field {measure(lambda: camera.render_field(pose)):.2f}, "
        f"geoms by ray {measure(lambda: camera.caster.cast(data, pose)):.2f}", end="")  # fmt: skip
  if gl:
    name = task.robot.camera.full_identifier
    call = lambda: physics.render(*size, camera_id=name)  # noqa: E731
    print(f"; MuJoCo's GL picture {measure(call, 30):.2f}, and as much for its depth", end="")
  print()


def main(settings: Settings) -> None:
  """Runs the benchmark."""
  os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[0]})
  bundle = loading.open_scene(settings.scene)
  renderer = loading.load_renderer(bundle)
  variants = [
    robot_variant(f"{settings.task}, {h}x{w}", settings, bundle, image_size=(h, w),
                  renderer=renderer)
    for h, w in SIZES
  ]  # fmt: skip
  variants.append(robot_variant(f"{settings.task}, no camera", settings, bundle, image_size=None))
  if settings.humanoid:
    variants.append(humanoid_variant())
  for variant in variants:
    variant.turn(5)
    variant.turns.clear()
    variant.cpu.clear()
    variant.resets.clear()
  for _ in range(settings.rounds):
    for variant in variants:
      variant.turn(settings.steps)
  print(f"one core, {settings.rounds} turns of {settings.steps} steps")
  print(
    f"{'':28s}{'steps/s':>9s}{'median ms':>11s}{'worst ms':>10s}{'CPU ms':>9s}{'reset ms':>10s}"
  )
  for variant in variants:
    turns = 1e3 * np.array(variant.turns)
    reset = 1e3 * np.median(variant.resets)
    print(f"{variant.name:28s}{1e3 / turns.mean():9.0f}{np.median(turns):11.2f}"
          f"{turns.max():10.2f}{1e3 * np.median(variant.cpu):9.2f}{reset:10.2f}")  # fmt: skip
  for variant, size in zip(variants, SIZES, strict=False):
    print_parts(variant, size, settings.humanoid)


if __name__ == "__main__":
  main(tyro.cli(Settings))
