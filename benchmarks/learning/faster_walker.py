"""Searches for a walker that reaches the goals sooner, by CMA-ES over gait and steering.

  python benchmarks/learning/faster_walker.py --minutes 25 --found out/walker.json

Candidates walk to the goals of trials that are not the protocol's, without pictures, in the worlds
of `suite.gaits.tuning`: strong and weak motors, floors, delays. A generation's candidates meet the
same trials and draws, the next generation's others. What is written after every generation is the
mean of the search, as `launch/distill.py --teacher` reads it; it is not the luckiest candidate. A
search that was cut short begins anew from what it wrote (`--start`).
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import concurrent.futures
import dataclasses
import functools
import multiprocessing
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import harness

harness.one_thread()

import numpy as np

from nerf2real.agents.distill.collecting.evaluator import other_trials
from nerf2real.agents.distill.teacher import TEACHERS, WalkerSettings
from nerf2real.core.serialization import read_json, write_json
from nerf2real.evaluation import runner
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.plant import Plant, Trial
from nerf2real.evaluation.plants.simulated import SimulatedPlant
from nerf2real.evaluation.policies.policy import GaitPolicy
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.suite.effects import write_effects
from nerf2real.suite.gaits import tuning
from nerf2real.suite.gaits.evolution import Evolution
from nerf2real.suite.protocols import NAVIGATION
from nerf2real.suite.scene import open_scene

# Parameter: its unit in the search, chosen: a tenth of the walkers' own values or so.
GAIT = {
  "stop_time": 0.03,
  "max_turn": 0.01,
  "period": 0.015,
  "height": 0.0015,
  "spread": 0.002,
  "sway": 0.002,
  "sway_lead": 0.1,
  "lift": 0.002,
  "swing": 0.015,
  "stride": 0.006,
  "backset": 0.003,
  "lean": 0.012,
  "tilt": 0.006,
  "lead": 0.003,
  "pitch_gain": 0.02,
  "roll_gain": 0.03,
}
STEERING = {"lookahead": 0.03, "turn_gain": 0.2, "turn_first": 0.12}
_WIDTH = 0.6  # of the first generation, in these units; chosen
_MAX_TURN = 0.3  # rad: the joints' limit
_SECONDS = 12.0  # a success in no time is worth 1, in this long 0
_FAILURE = -2.0  # chosen: as bad as a walk of 36 s; one in 54 costs as much as 0.5 s a walk
_SHARES = (5, 4, 3, 2)  # trials of a candidate in each of the worlds


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to search from, and for how long."""

  minutes: float = 25.0
  """Time after which no generation begins [min]."""
  start: str = "swift"
  """One of `teacher.TEACHERS` that navigates, or a walker's JSON."""
  population: int = 10
  """Candidates in a generation."""
  processes: int = 2
  """Candidates that walk at the same time."""
  scene: str = "scenes/data/room"
  """The bundle's folder."""
  trials: int = 27
  """Of the walkers' comparison at the end, in each world; draws that the search never met."""
  seed: int = 0
  """Of the search."""
  found: Path = Path("out/walker.json")
  """Where the walker is written."""


class Walk(NamedTuple):
  """How a walk ended."""

  success: bool
  seconds: float


def walker_at(start: WalkerSettings, candidate: np.ndarray) -> WalkerSettings:
  """Returns the walker so many widths [P] away from another."""

  def moved(settings: Any, widths: dict[str, float], by: np.ndarray) -> Any:
    changes = {
      name: float(getattr(settings, name) + width * step)
      for (name, width), step in zip(widths.items(), by, strict=True)
    }
    return dataclasses.replace(settings, **changes)

  gait = moved(start.gait, GAIT, candidate[: len(GAIT)])
  gait = dataclasses.replace(gait, max_turn=min(gait.max_turn, _MAX_TURN))
  steering = moved(start.steering, STEERING, candidate[len(GAIT) :])
  return dataclasses.replace(start, gait=gait, steering=steering)


def score(walks: Sequence[Walk]) -> float:
  """Returns the mean worth of walks: 1 for a success in no time, less by its time, or a failure."""
  return float(np.mean([1 - w.seconds / _SECONDS if w.success else _FAILURE for w in walks]))


@functools.cache
def _plants(scene: str) -> list[Plant]:
  """Returns a plant without pictures for each world, one set a process."""
  bundle = open_scene(scene)
  made: list[Plant] = []
  with tempfile.TemporaryDirectory() as folder:
    for index, world in enumerate(tuning.WORLDS):
      effects = Path(folder) / f"{index}.json"
      write_effects(effects, world)
      settings = EvaluationSettings(effects=effects if world else None)
      made.append(SimulatedPlant(bundle, settings, image_size=None))
  return made


def walk(scene: str, settings: WalkerSettings, trials: Sequence[tuple[int, Trial]]) -> list[Walk]:
  """Walks trials, each in the world of its number."""
  bundle, walks = open_scene(scene), []
  for index, (world, trial) in enumerate(trials):
    walker = GaitPolicy(bundle, NAVIGATION, settings=settings.gait, steering=settings.steering)
    episode = runner.run_trial(_plants(scene)[world], walker, trial, group=NAVIGATION, index=index)
    walks.append(Walk(episode.success, episode.duration))
  return walks


def search(settings: Settings, pool: concurrent.futures.Executor) -> WalkerSettings:
  """Returns where the search stands when its time is over; written after every generation."""
  begin = time.monotonic()
  start = start_of(settings.start)
  listed = other_trials([trial for _, trial in plants.trials(NAVIGATION)])
  rng = np.random.default_rng(settings.seed)
  count = len(GAIT) + len(STEERING)
  evolution = Evolution(np.zeros(count), _WIDTH, settings.population, settings.seed)
  generation = 0
  while time.monotonic() - begin < 60 * settings.minutes:
    worlds = [world for world, count in enumerate(_SHARES) for _ in range(count)]
    picked = rng.choice(len(listed), len(worlds), replace=False)
    trials = [
      (world, listed[i]._replace(seed=listed[i].seed + 1_000 * (generation + 1)))
      for world, i in zip(worlds, picked, strict=True)
    ]
    candidates = evolution.ask()
    walkers = [walker_at(start, candidate) for candidate in candidates]
    walked = list(pool.map(walk, [settings.scene] * len(walkers), walkers, [trials] * len(walkers)))
    scores = np.array([score(walks) for walks in walked])
    evolution.tell(candidates, scores)
    write_json(settings.found, walker_at(start, evolution.mean))
    failed = sum(not w.success for walks in walked for w in walks)
    print(
      f"{generation:3d} {time.monotonic() - begin:5.0f} s  best {scores.max():+.3f} "
      f"median {np.median(scores):+.3f}  {failed} of {len(walkers) * len(trials)} walks failed",
      flush=True,
    )
    generation += 1
  return walker_at(start, evolution.mean)


def start_of(name: str) -> WalkerSettings:
  """Returns a walker by its name, or from its JSON."""
  if name in TEACHERS:
    return TEACHERS[name]()
  return read_json(name, WalkerSettings)


def summary(walks: Sequence[Walk]) -> dict[str, harness.Value]:
  """Figures of one walker in one world."""
  times = [w.seconds for w in walks if w.success]
  return {
    "success": harness.Rate(len(times), len(walks)),
    "median_time_s": float(np.median(times)) if times else float("nan"),
    "mean_time_s": float(np.mean(times)) if times else float("nan"),
  }


def main(settings: Settings) -> None:
  """Searches, and compares what was found with where it began, trial by trial."""
  context = multiprocessing.get_context("spawn")
  with concurrent.futures.ProcessPoolExecutor(settings.processes, context) as pool:
    settings.found.parent.mkdir(parents=True, exist_ok=True)
    walkers = {settings.start: start_of(settings.start), "found": search(settings, pool)}
    listed = other_trials([trial for _, trial in plants.trials(NAVIGATION)])
    spread = [listed[i] for i in np.linspace(0, len(listed) - 1, settings.trials).astype(int)]
    jobs = [(name, world) for name in walkers for world in range(len(tuning.WORLDS))]
    walked = pool.map(
      walk,
      [settings.scene] * len(jobs),
      [walkers[name] for name, _ in jobs],
      [[(world, trial) for trial in spread] for _, world in jobs],
    )
    rows = {
      f"{name}, world {world}": summary(walks)
      for (name, world), walks in zip(jobs, walked, strict=True)
    }
  details = {"walker": dataclasses.asdict(walkers["found"])}
  harness.finish("faster_walker", rows, settings, seed=settings.seed, details=details)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
