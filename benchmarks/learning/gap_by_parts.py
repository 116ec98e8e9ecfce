"""Which part of the gap between simulation and virtual robot a policy feels: one swapped at a time.

  python benchmarks/learning/gap_by_parts.py --policy shipped --trials 15

Every condition is an evaluation as by `launch/evaluate.py --swap` in a folder of its own; what is
there already is not run again. In the simulation the robot's pictures (with and without its lens),
lens or camera delay are put in, compared with the plain simulation; on the virtual robot the
simulation's, or the data sheets' physics, compared with the plain virtual robot; and the two with
each other. Differences are paired by trial: success with Tango's score interval; time and
localisation error, over trials that both conditions reach, with the 95 % interval of a bootstrap
over trials.
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import dataclasses
import functools
from pathlib import Path
from typing import Literal, NamedTuple

from benchmarks import harness

harness.one_thread()

import numpy as np

from nerf2real.evaluation import episodes, paired, session
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.settings import EvaluationSettings

Part = Literal["picture", "lens", "delay", "physics"]


class Condition(NamedTuple):
  """Where a policy is evaluated."""

  plant: Literal["sim", "virtual"]
  parts: tuple[Part, ...] = ()


CONDITIONS = {
  "simulation": Condition("sim"),
  "simulation_with_the_robots_pictures": Condition("sim", ("picture", "lens")),
  "simulation_with_the_robots_room": Condition("sim", ("picture",)),
  "simulation_with_the_robots_lens": Condition("sim", ("lens",)),
  "simulation_with_the_robots_camera_delay": Condition("sim", ("delay",)),
  "robot_with_the_simulations_pictures_and_delay": Condition(
    "virtual", ("picture", "lens", "delay")
  ),
  "robot_with_the_simulations_pictures": Condition("virtual", ("picture", "lens")),
  "robot_with_the_simulations_camera_delay": Condition("virtual", ("delay",)),
  "robot_with_the_data_sheets_physics": Condition("virtual", ("physics",)),
  "robot": Condition("virtual"),
}
_PLAIN = {"sim": "simulation", "virtual": "robot"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to compare."""

  policy: str = "shipped"
  """As of launch/evaluate.py."""
  conditions: tuple[str, ...] = tuple(CONDITIONS)
  """Which; those without a part are the references."""
  trials: int = 15
  """Trials of the navigation protocol in each condition, spread over it."""
  robots: tuple[int, ...] = (1,)
  """Seeds of the virtual robots."""
  processes: int = 1
  """Processes that share a condition's trials."""
  folder: Path = Path("out/gap_by_parts")
  """Holds a folder of episodes for every condition."""


def evaluated(name: str, settings: Settings) -> list[episodes.Episode]:
  """Evaluates what is missing of a condition; returns the episodes of the trials."""
  condition = CONDITIONS[name]
  folder = settings.folder / name
  evaluation = EvaluationSettings(
    policy=settings.policy,
    plant=condition.plant,
    swap=condition.parts,
    robot_seed=settings.robots,
    trials=settings.trials,
    processes=settings.processes,
    out=folder,
  )
  session.evaluate(evaluation, functools.partial(print, flush=True))
  chosen = {index for index, _ in session.choose(plants.trials("navigation"), settings.trials)}
  return [found for found in episodes.Store(folder).episodes if found.index in chosen]


def summary(found: list[episodes.Episode]) -> dict[str, harness.Value]:
  """Figures of a condition."""
  reached = [episode for episode in found if episode.success]
  times = [episode.time for episode in reached if episode.time is not None]
  errors = [e.localisation_error for e in reached if e.localisation_error is not None]
  return {
    "success": harness.Rate(len(reached), len(found)),
    "median_time_s": float(np.median(times)) if times else float("nan"),
    "median_error_m": float(np.median(errors)) if errors else float("nan"),
  }


def difference(
  found: list[episodes.Episode], reference: list[episodes.Episode]
) -> dict[str, harness.Value]:
  """Figures of a condition less its reference."""
  result = paired.difference(found, reference)
  figures: dict[str, harness.Value] = {
    "trials": result.trials,
    "won": result.won,
    "lost": result.lost,
  }
  named = {"success": result.success, "time_s": result.time, "error_m": result.error}
  for name, interval in named.items():
    values = (float("nan"),) * 3 if interval is None else interval
    quantity, _, unit = name.partition("_")
    for end, value in zip(("", "_low", "_high"), values, strict=True):
      figures[quantity + end + (f"_{unit}" if unit else "")] = value
  return figures


def main(settings: Settings) -> None:
  """Evaluates every condition and reports the differences."""
  unknown = [name for name in settings.conditions if name not in CONDITIONS]
  if unknown:
    raise SystemExit(f"Unknown condition {unknown[0]!r}: expected one of {', '.join(CONDITIONS)}.")
  found = {name: evaluated(name, settings) for name in settings.conditions}
  rows = {name: summary(episodes) for name, episodes in found.items()}
  differences = {
    f"{name}_less_plain": difference(episodes, found[_PLAIN[CONDITIONS[name].plant]])
    for name, episodes in found.items()
    if CONDITIONS[name].parts and _PLAIN[CONDITIONS[name].plant] in found
  }
  if set(_PLAIN.values()) <= set(found):
    differences["robot_less_simulation"] = difference(found["robot"], found["simulation"])
  harness.finish("gap_by_parts", rows | differences, settings, seed=0)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
