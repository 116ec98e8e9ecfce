"""Success in simulation against success on virtual robots, over several policies.

  python benchmarks/learning/twin.py --policies runs/x/policy/newest kept/1 kept/2 --trials 18

Every policy is evaluated as by `launch/evaluate.py --plant both` into one folder; what is there
already is not run again. Reported are the rates, their correlation over the policies and the mean
difference, both with 95 % bootstrap intervals.
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import dataclasses
import functools
from pathlib import Path

from benchmarks import harness

harness.one_thread()

from nerf2real.evaluation import episodes, session, twin
from nerf2real.evaluation.settings import EvaluationSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to compare."""

  policies: tuple[str, ...]
  """Folders of exported policies, "walker" for the scripted one; three or more."""
  trials: int = 18
  """Trials of the navigation protocol on each plant, spread over it."""
  robots: tuple[int, ...] = (1, 2, 3)
  """Seeds of the virtual robots."""
  folder: Path = Path("out/twin")
  """Folder of the episodes and their report."""


def main(settings: Settings) -> None:
  """Evaluates what is missing and reports the agreement."""
  for policy in settings.policies:
    evaluation = EvaluationSettings(
      policy=policy,
      plant="both",
      robot_seed=settings.robots,
      trials=settings.trials,
      out=settings.folder,
    )
    session.evaluate(evaluation, functools.partial(print, flush=True))
  pairs = twin.pairs_of(episodes.Store(settings.folder).episodes)
  found = twin.agreement(pairs)
  rows: dict[str, dict[str, harness.Value]] = {
    pair.policy: {
      "simulation": harness.Rate(*pair.simulated),
      "virtual_robots": harness.Rate(*pair.virtual),
    }
    for pair in pairs
  }
  rows |= {
    name: {"value": interval.value, "low": interval.low, "high": interval.high}
    for name, interval in found._asdict().items()
  }
  harness.finish("twin", rows, settings, seed=0)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
