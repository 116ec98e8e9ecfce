"""Measures the scripted walker on every plant: a metre straight ahead, then five goals.

Straight ahead only the gait acts, without a pose. The goals are reached one after
another, steered by the true pose. Simulation: episodes as in training, without pushes. Virtual
robots: what is hidden in each is drawn from its seed; "data sheet" has nothing hidden.

  python benchmarks/simulation/walker.py --out benchmarks/results/walker.md
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and mujoco are imported)

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from benchmarks import harness

harness.one_thread()

import numpy as np

from nerf2real import real, suite
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.gaits.walk import Command, Gait
from nerf2real.suite.gaits.walker import Walker
from nerf2real.suite.op3.constants import MIN_HEIGHT, MIN_UPRIGHT
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import RandomisationSettings

GOALS = (
  (0.6, 0.0),
  (0.6, 0.5),
  (0.0, 0.5),
  (-0.3, 0.0),
  (0.2, -0.3),
)  # m
_REACHED = 0.15  # m
_STRAIGHT_LIMIT, _GOALS_LIMIT = 15.0, 60.0  # s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the benchmark."""

  episodes: int = 10
  """Episodes in simulation, of different draws."""
  robots: int = 10
  """Virtual robots."""


class Seen(NamedTuple):
  """The observer's view of the robot."""

  pose: Pose
  fallen: bool


class Result(NamedTuple):
  """One walk."""

  fell: bool
  metre: float  # s to the first metre; NaN if it was not reached
  sideways: float  # m at that moment
  goals: int  # reached of five
  goals_fell: bool


Run = tuple[Any, Callable[[], Seen]]  # environment and observer


def walk(environment: Any, see: Callable[[], Seen]) -> Result:
  """Walks a metre and, in another episode, to five goals."""
  timestep, gait = environment.reset(), Gait()
  start, metre, sideways, step = see().pose, float("nan"), float("nan"), 0
  seen = see()
  while not (timestep.last() or seen.fallen) and step * 0.025 < _STRAIGHT_LIMIT:
    observation = timestep.observation
    timestep = environment.step(
      gait.act(
        Command(1.0), gyroscope=observation["gyroscope"][-1], gravity=observation["gravity"][-1]
      )
    )
    seen, step = see(), step + 1
    offset = seen.pose.xy - start.xy
    if np.linalg.norm(offset) >= 1.0:
      metre = step * 0.025
      sideways = float(abs(np.cos(start.yaw) * offset[1] - np.sin(start.yaw) * offset[0]))
      break
  fell = seen.fallen
  timestep, walker = environment.reset(), Walker(EmptyFloor())
  seen = see()
  origin = seen.pose
  walker.reset(origin)
  reached, step = 0, 0
  while reached < len(GOALS) and not (timestep.last() or seen.fallen):
    if step * 0.025 >= _GOALS_LIMIT:
      break
    goal = origin.xy + np.array(GOALS[reached])
    timestep = environment.step(walker.act(timestep.observation, goal=goal, pose=seen.pose))
    seen, step = see(), step + 1
    reached += bool(np.linalg.norm(seen.pose.xy - goal) < _REACHED)
  return Result(fell, metre, sideways, reached, seen.fallen)


def simulated(count: int) -> Iterator[tuple[str, Result]]:
  """Walks in simulation."""
  environment = suite.load(
    "nerf_nav",
    scene=EmptyFloor(),
    image_size=None,
    random=0,
    time_limit=_GOALS_LIMIT + 5,
    randomisation=RandomisationSettings(pushes=False),
    privileged=False,
  )
  task = environment.task
  task.set_start(Pose(0.0, 0.0, 0.0))

  def see() -> Seen:
    return Seen(task.state.pose, bool(task.fallen))

  for episode in range(count):
    yield f"simulation, episode {episode}", walk(environment, see)


def rehearsed(count: int) -> Iterator[tuple[str, Result]]:
  """Walks on virtual robots."""
  for seed in [None, *range(count)]:
    with VirtualRobot(world="floor", seed=seed, stepped=True) as robot:
      environment = real.load(
        "nerf_nav",
        robot=robot.connection(),
        image_size=None,
        scene=EmptyFloor(),
        time_limit=_GOALS_LIMIT + 5,
      )

      def see(robot: VirtualRobot = robot) -> Seen:
        truth = robot.truth()
        low = truth.rotation[2, 2] < MIN_UPRIGHT or truth.position[2] < MIN_HEIGHT
        return Seen(truth.pose, bool(truth.touches_floor or low))

      with environment:
        name = "data sheet" if seed is None else f"seed {seed}"
        yield f"virtual robot, {name}", walk(environment, see)


def summary(results: list[Result]) -> dict[str, harness.Value]:
  """Returns the figures of a plant."""
  metres = [r.metre for r in results if np.isfinite(r.metre)]
  return {
    "first_metre": harness.Rate(sum(not r.fell for r in results), len(results)),
    "all_goals": harness.Rate(sum(r.goals == len(GOALS) for r in results), len(results)),
    "fastest_metre_s": min(metres, default=float("nan")),
    "slowest_metre_s": max(metres, default=float("nan")),
    "sideways_largest_m": max((r.sideways for r in results), default=float("nan")),
  }


def main(settings: Settings) -> None:
  """Walks everywhere and prints the table."""
  figures: dict[str, dict[str, harness.Value]] = {}
  walks: dict[str, dict[str, harness.Value]] = {}
  plants = {
    "simulation": simulated(settings.episodes),
    "virtual_robot": rehearsed(settings.robots),
  }
  for plant, runs in plants.items():
    results = []
    for name, result in runs:
      results.append(result)
      walks[name] = result._asdict()
      print(name, *(f"{key} {value}" for key, value in walks[name].items()), flush=True)
    figures[plant] = summary(results)
  harness.finish("walker", figures, settings, seed=0, words=harness.table(walks, first="plant"))


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
