"""Runs episodes of a task with a driver, and films them."""

import contextlib
import sys
from pathlib import Path

from rich.progress import track

from nerf2real import suite
from nerf2real.suite.op3 import constants
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.sensors.camera import CameraSettings
from nerf2real.suite.tasks.base import Outcome
from nerf2real.suite.views.drivers import MakeDriver, Walking, move_on
from nerf2real.suite.views.film import Film, describe, open_film


def run_episodes(
  task_name: str = "nerf_nav",
  *,
  scene: Path | None = None,
  effects: Path | None = None,
  driver: MakeDriver = Walking,
  seconds: float = 10.0,
  image_size: tuple[int, int] = (60, 80),
  camera: CameraSettings | None = None,
  seed: int = 0,
  pushes: bool = False,
  video: Path | None = None,
) -> list[str]:
  """Runs episodes; returns a line for each goal that was reached and each episode that ended.

  Args:
    task_name: Task.
    scene: Folder of a scene bundle; None is the built-in room.
    effects: An effects.json: what the nominal model lacks.
    driver: Makes what acts.
    seconds: Length of the run, over as many episodes as it takes [s].
    image_size: Height and width of the robot's picture [pixel].
    camera: Of the robot; the suite's own if None.
    seed: Of the episodes.
    pushes: Whether the robot is pushed at random, as in training.
    video: Where to write a film (.mp4, .webp, .gif); None writes none.
  """
  environment = suite.load(
    task_name,
    scene=scene,
    effects=effects,
    random=seed,
    image_size=image_size,
    camera=camera,
    randomisation=RandomisationSettings(pushes=pushes),
  )
  timestep = environment.reset()
  task = environment.task
  acting = driver(task)
  lines: list[str] = []
  steps = round(seconds / constants.CONTROL_TIMESTEP)
  with contextlib.ExitStack() as stack:
    film = None
    if video is not None:
      film = Film(environment, stack.enter_context(open_film(video)))
    what = "filming" if film else task_name
    for _ in track(range(steps), description=what, disable=not sys.stderr.isatty()):
      if timestep.first():
        acting.restart()
        if film is not None:
          film.restart()
      timestep = environment.step(acting.act(timestep.observation))
      if timestep.last():
        lines.append(_line(task.outcome))
      elif film is not None:
        density = acting.density(film.map_extent)
        film.add(timestep.observation, describe(task_name, task), density=density)
      before = task.outcome
      move_on(task)
      if before.success and not task.outcome.success:
        lines.append(f"goal reached after {before.success_time:.2f} s, on to the next")
  return lines


def _line(outcome: Outcome) -> str:
  ending = outcome.ending or "time limit"
  success = f"success after {outcome.success_time:.2f} s" if outcome.success else "no success"
  return f"episode of {outcome.duration:.2f} s: {success}, ended by {ending}"
