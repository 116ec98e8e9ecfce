"""The teacher of a loop's training: the walker that copes best with the effects, or a fitted one.

Of walkers that succeed as often the fastest teaches, as a slower one would teach the policy to be
slow.

The scripted gaits were searched for on the nominal robot. Where none of them copes with what was
identified (a load and a slope that push the same way, say), each is tried standing taller, too, as
a straighter leg carries the same weight with less torque, and then a few parameters of the best one
are searched for in the simulation with the effects, on trials that are not the protocol's.
"""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nerf2real.agents.distill.collecting.evaluator import other_trials
from nerf2real.agents.distill.teacher import TEACHERS, WalkerSettings
from nerf2real.core.serialization import read_json, write_json
from nerf2real.evaluation import runner
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.plant import Plant, Trial
from nerf2real.evaluation.plants.simulated import SimulatedPlant
from nerf2real.evaluation.policies.policy import GaitPolicy
from nerf2real.evaluation.session import choose
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.suite.gaits.evolution import Evolution
from nerf2real.suite.protocols import NAVIGATION

WALKERS = ("quick", "steady", "swift")  # teachers that navigate
ADAPTED = "teacher.json"
_CHOICE = "teachers.json"
_TRIALS = 9  # of each teacher; seconds of processor time each, without pictures
_COPES = 0.85  # of its trials, from which a walker is taken as it is: at most one of nine fails
_GENERATIONS, _POPULATION, _DRAWN = 6, 8, 6  # of the search; trials of a candidate
_TALLER = (0.004, 0.008)  # m; with 0.012 the legs are straight
# Parameter: width of the first round. What carries a displaced centre of mass, or treads lighter;
# with twice these widths half of the first candidates fall at once.
_SEARCHED = {
  "shift": 0.006,
  "backset": 0.004,
  "stride": 0.006,
  "lift": 0.003,
  "spread": 0.002,
  "sway": 0.002,
  "height": 0.002,
}


class Choice(NamedTuple):
  """A teacher, and how the walkers did with the effects."""

  teacher: str  # a name in TEACHERS, or the file of a walker that is none of them
  successes: dict[str, int]  # by walker; the taller and the fitted ones' among them
  trials: int  # of each


def choose_teacher(
  folder: Path, effects: Path, scene: Any, *, seed: int, time_limit: float | None = None
) -> Choice:
  """Returns the teacher that copes best with the effects; kept in the folder.

  Args:
    folder: Of the training; the choice and a fitted walker are kept in it.
    effects: effects.json, drawn from its intervals.
    scene: The bundle.
    seed: Of the search.
    time_limit: Length of a trial [s]; the task's own if None.
  """
  kept = folder / _CHOICE
  if kept.exists():
    return read_json(kept, Choice)
  folder.mkdir(parents=True, exist_ok=True)
  with _plant(scene, effects, time_limit) as plant:
    fresh = _Trials(plant, scene)
    walkers = {name: TEACHERS[name]() for name in WALKERS}
    ranks = {name: fresh.rank(walker) for name, walker in walkers.items()}

    def best() -> str:
      return max(ranks, key=lambda name: ranks[name])

    def copes() -> bool:
      return ranks[best()].successes >= _COPES * len(fresh.chosen)

    if not copes():
      taller = _taller(walkers)
      walkers |= taller
      ranks |= {name: fresh.rank(walker) for name, walker in taller.items()}
    if not copes():
      fitted = fit(plant, scene, walkers[best()], seed=seed)
      walkers["fitted"], ranks["fitted"] = fitted, fresh.rank(fitted)
  teacher = best()
  if teacher not in WALKERS:
    write_json(folder / ADAPTED, walkers[teacher])
    teacher = str((folder / ADAPTED).resolve())
  successes = {name: rank.successes for name, rank in ranks.items()}
  found = Choice(teacher, successes, len(fresh.chosen))
  write_json(kept, found)
  return found


def _taller(walkers: Mapping[str, WalkerSettings]) -> dict[str, WalkerSettings]:
  """Returns the walkers with straighter knees, by name."""
  return {
    f"{name}, {1e3 * by:.0f} mm taller": dataclasses.replace(
      walker, gait=dataclasses.replace(walker.gait, height=walker.gait.height + by)
    )
    for name, walker in walkers.items()
    for by in _TALLER
  }


def fit(plant: Plant, scene: Any, start: WalkerSettings, *, seed: int) -> WalkerSettings:
  """Returns a walker whose gait was searched for on a plant by CMA-ES, from another's.

  A generation's candidates meet the same trials and draws, the next generation others. What is
  returned is the mean of the last round.
  """
  names, widths = tuple(_SEARCHED), np.array(list(_SEARCHED.values()))
  origin = np.array([getattr(start.gait, name) for name in names])

  def walker(candidate: np.ndarray) -> WalkerSettings:
    values = dict(zip(names, (float(v) for v in origin + widths * candidate), strict=True))
    return dataclasses.replace(start, gait=dataclasses.replace(start.gait, **values))

  listed = other_trials([trial for _, trial in plants.trials(NAVIGATION)])
  rng = np.random.default_rng(seed)
  evolution = Evolution(np.zeros(len(names)), 1.0, _POPULATION, seed)
  for generation in range(_GENERATIONS):
    picked = rng.choice(len(listed), _DRAWN, replace=False)
    trials = [listed[i]._replace(seed=listed[i].seed + generation) for i in picked]
    candidates = evolution.ask()
    scores = [_score(plant, scene, walker(candidate), trials) for candidate in candidates]
    evolution.tell(candidates, np.array(scores))
  return walker(evolution.mean)


def _score(plant: Plant, scene: Any, settings: WalkerSettings, trials: Sequence[Trial]) -> float:
  """Returns the mean over trials: 1 to 0.5 of a success by its time, less of what stayed up."""
  limit, total = plant.time_limit, 0.0
  for index, trial in enumerate(trials):
    episode = _episode(plant, scene, settings, trial, index)
    share = min(1.0, episode.duration / limit)
    total += 1.0 - 0.5 * share if episode.success else 0.3 * share
  return total / len(trials)


class _Rank(NamedTuple):
  """How well a walker did: of two that succeed as often the faster one did better."""

  successes: int
  haste: float  # mean time of the successes [s], negative


class _Trials:
  """Trials that walkers are ranked on: neither those that are reported nor those of a search."""

  def __init__(self, plant: Plant, scene: Any):
    self._plant, self._scene = plant, scene
    listed = [trial for _, (_, trial) in choose(plants.trials(NAVIGATION), _TRIALS)]
    unmet = len(plants.trials(NAVIGATION)) + _GENERATIONS  # beyond the seeds of a search
    self.chosen = [trial._replace(seed=trial.seed + unmet) for trial in other_trials(listed)]

  def rank(self, settings: WalkerSettings) -> _Rank:
    ran = [
      _episode(self._plant, self._scene, settings, trial, index)
      for index, trial in enumerate(self.chosen)
    ]
    times = [episode.duration for episode in ran if episode.success]
    return _Rank(len(times), -float(np.mean(times)) if times else 0.0)


def _episode(plant: Plant, scene: Any, settings: WalkerSettings, trial: Trial, index: int) -> Any:
  walker = GaitPolicy(scene, NAVIGATION, settings=settings.gait, steering=settings.steering)
  return runner.run_trial(plant, walker, trial, group=NAVIGATION, index=index)


@contextlib.contextmanager
def _plant(scene: Any, effects: Path, time_limit: float | None) -> Iterator[Plant]:
  """Yields the simulation with the effects, without pictures."""
  settings = EvaluationSettings(effects=effects, time_limit=time_limit)
  plant = SimulatedPlant(scene, settings, image_size=None, draw_effects=True)
  with contextlib.closing(plant):
    yield plant
