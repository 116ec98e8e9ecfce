"""How fast and how surely scripted walkers walk on and on, and a search for a better one.

  python benchmarks/learning/long_walks.py --walkers swift brisk nimble
  python benchmarks/learning/long_walks.py --walkers brisk --noise 0.15
  python benchmarks/learning/long_walks.py --walkers brisk --minutes 9 --searched 0 2 3

Trials are short and winding and show few falls. Here every walker walks on an empty floor, straight
on and in curves, in the worlds of `suite.gaits.tuning`; `--noise` disturbs its actions as a driving
teacher's are in a distillation. With `--minutes` the gait of the first walker is searched from by
CMA-ES; what is written after every generation is the mean of the search, as `launch/distill.py
--teacher` reads it.
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import concurrent.futures
import dataclasses
import functools
import multiprocessing
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks import harness

harness.one_thread()

import numpy as np

from benchmarks.learning.faster_walker import GAIT, STEERING, start_of, walker_at
from nerf2real.agents.distill.teacher import WalkerSettings
from nerf2real.core.serialization import write_json
from nerf2real.suite.environment import Environment
from nerf2real.suite.gaits import tuning
from nerf2real.suite.gaits.evolution import Evolution
from nerf2real.suite.gaits.walk import Command, Gait
from nerf2real.suite.op3.constants import CONTROL_TIMESTEP

COMMANDS = {
  "straight": Command(1.0, 0.0),
  "bent": Command(1.0, 0.15),
  "left curve": Command(0.6, 0.5),
  "right curve": Command(0.6, -0.5),
  "on the spot": Command(0.0, 1.0),
}
_STEP = 17  # control steps over which a speed is taken, about a period: swaying is no speed
# What counts as fast: about what `brisk` does in the nominal world.
_SPEED, _CURVE_TURN, _SPOT_TURN = 0.25, 0.65, 1.2  # m/s, rad/s, rad/s
_BEST_TURN = 1.4  # times that; turning faster is worth no more
_DRIFT = 0.12  # rad/s of turning that a walk without a turning command is forgiven
_FALL = -1.5  # worth of a walk that ended in a fall; a fast one's is about 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Who walks where, and whether a better walker is searched for."""

  walkers: tuple[str, ...] = ("swift", "brisk", "nimble")
  """Of `teacher.TEACHERS`, or walkers' JSON."""
  seconds: float = 8.0
  """Length of a walk [s]."""
  repetitions: int = 10
  """Walks of every walker with every command in every world."""
  noise: float = 0.0
  """Largest standard deviation of the noise on its actions, drawn for every walk."""
  minutes: float = 0.0
  """Time after which no generation of a search begins [min]; 0: none is made."""
  searched: tuple[int, ...] = (0, 1, 2, 3)
  """Worlds of the search."""
  population: int = 12
  """Candidates in a generation."""
  width: float = 0.7
  """Of the first generation, in the units of `faster_walker.GAIT`."""
  processes: int = 2
  """Walkers that walk at the same time."""
  seed: int = 0
  """Of search and noise."""
  found: Path = Path("out/walker.json")
  """Where the walker of a search is written."""


class Walk(NamedTuple):
  """A walk on the empty floor."""

  speed: float  # m/s, along the way
  turn: float  # rad/s, to the left
  fell: bool


@functools.cache
def _environments(seconds: float) -> list[Environment]:
  """Returns an environment for each world, one set a process."""
  return tuning.make_environments(len(tuning.WORLDS), seconds)


def walk(
  walker: WalkerSettings, world: int, command: Command, *, seconds: float, noise: float, seed: int
) -> Walk:
  """Walks as commanded for so long [s], or until it falls."""
  environment = _environments(seconds)[world]
  gait = Gait(walker.gait)
  rng = np.random.default_rng(seed)
  deviation = rng.uniform(0.0, noise)
  timestep = environment.reset()
  gait.reset()
  yaws, places = [0.0], [np.zeros(2)]
  while not timestep.last():
    observation = timestep.observation
    action = gait.act(
      command, gyroscope=observation["gyroscope"][-1], gravity=observation["gravity"][-1]
    )
    if deviation:
      action = np.clip(action + rng.normal(0.0, deviation, action.shape), -1, 1)
      timestep = environment.step(action.astype(np.float32))
      gait.follow(timestep.observation["previous_control"][-1])
    else:
      timestep = environment.step(action)
    state = environment.task.state
    yaws.append(state.yaw)
    places.append(np.array(state.position[:2]))
  way = np.linalg.norm(np.diff(np.array(places)[::_STEP], axis=0), axis=1).sum()
  duration = CONTROL_TIMESTEP * (len(places) - 1)
  fell = environment.task.outcome.ending is not None
  return Walk(float(way) / duration, float(np.unwrap(yaws)[-1]) / duration, fell)


def worth(command: Command, walked: Walk) -> float:
  """Returns what a walk is worth: about 1 where it is fast, and little where it ended in a fall."""
  if walked.fell:
    return _FALL
  if command.forward == 0.0:
    return min(abs(walked.turn) / _SPOT_TURN, _BEST_TURN)
  if command.forward < 1.0:
    turned = min(abs(walked.turn) / _CURVE_TURN, _BEST_TURN)
    return 0.5 * walked.speed / _SPEED + 0.5 * turned
  drift = 0.0 if command.turn else max(0.0, abs(walked.turn) - _DRIFT)
  return walked.speed / _SPEED - drift


def _walks(walker: WalkerSettings, world: int, seed: int, settings: Settings) -> list[Walk]:
  """Walks once with every command in a world."""
  how = {"seconds": settings.seconds, "noise": settings.noise}
  return [
    walk(walker, world, command, seed=seed + number, **how)  # type: ignore[arg-type]
    for number, command in enumerate(COMMANDS.values())
  ]


def search(settings: Settings, pool: concurrent.futures.Executor) -> WalkerSettings:
  """Returns where the search stands when its time is over; written after every generation."""
  begin = time.monotonic()
  start = start_of(settings.walkers[0])
  still = np.zeros(len(STEERING))  # of the steering, which an empty floor does not ask for
  evolution = Evolution(np.zeros(len(GAIT)), settings.width, settings.population, settings.seed)
  generation, seed = 0, settings.seed
  while time.monotonic() - begin < 60 * settings.minutes:
    candidates = evolution.ask()
    walkers = [walker_at(start, np.append(candidate, still)) for candidate in candidates]
    jobs = [(walker, world) for walker in walkers for world in settings.searched]
    seed += len(COMMANDS)
    walked = pool.map(
      functools.partial(_walks, seed=seed, settings=settings), *zip(*jobs, strict=True)
    )
    worths = [
      np.mean([worth(command, w) for command, w in zip(COMMANDS.values(), walks, strict=True)])
      for walks in walked
    ]
    scores = np.reshape(worths, (len(walkers), -1)).mean(axis=1)
    evolution.tell(candidates, scores)
    write_json(settings.found, walker_at(start, np.append(evolution.mean, still)))
    print(
      f"{generation:3d} {time.monotonic() - begin:5.0f} s  best {scores.max():+.3f} "
      f"median {np.median(scores):+.3f}",
      flush=True,
    )
    generation += 1
  return walker_at(start, np.append(evolution.mean, still))


def summary(command: str, walks: list[Walk]) -> dict[str, harness.Value]:
  """Figures of a walker's walks with one command in one world."""
  key = "turn_rad_s" if "curve" in command or "spot" in command else "speed_m_s"
  upright = [w for w in walks if not w.fell]
  value = [abs(w.turn) if key == "turn_rad_s" else w.speed for w in upright]
  return {
    "fell": harness.Rate(len(walks) - len(upright), len(walks)),
    key: float(np.mean(value)) if value else float("nan"),
  }


def main(settings: Settings) -> None:
  """Searches where asked, and measures the walkers."""
  context = multiprocessing.get_context("spawn")
  with concurrent.futures.ProcessPoolExecutor(settings.processes, context) as pool:
    walkers = {Path(name).stem: start_of(name) for name in settings.walkers}
    if settings.minutes:
      settings.found.parent.mkdir(parents=True, exist_ok=True)
      walkers["found"] = search(settings, pool)
    worlds = range(len(tuning.WORLDS))
    jobs = [
      (name, world, 1_000 + settings.seed + repetition * len(COMMANDS))
      for name in walkers
      for world in worlds
      for repetition in range(settings.repetitions)
    ]
    names, places, seeds = zip(*jobs, strict=True)
    chosen = [walkers[name] for name in names]
    walked = list(pool.map(functools.partial(_walks, settings=settings), chosen, places, seeds))
  rows = {
    f"{name}, world {world}, {command}": summary(
      command,
      [
        walks[number]
        for (who, where, _), walks in zip(jobs, walked, strict=True)
        if (who, where) == (name, world)
      ],
    )
    for name in walkers
    for world in worlds
    for number, command in enumerate(COMMANDS)
  }
  details = {"walkers": {name: dataclasses.asdict(walker) for name, walker in walkers.items()}}
  harness.finish("long_walks", rows, settings, seed=settings.seed, details=details)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
