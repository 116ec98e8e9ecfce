"""Success and time to the goal of policies on the same trials, and their paired differences.

  python benchmarks/learning/paired.py --policies agents/policies/nerf_nav runs/x/policy/newest

The first policy is the reference. Trials are those kept for choosing among policies, other headings
and draws than the protocol's (`agents/distill/collecting/evaluator.py`); --protocol takes the
protocol's own headings with this script's draws. Every policy meets the same start, goal and draws
in a trial. The time's difference is over trials in which both reach the goal, with the 95 %
interval of a bootstrap over trials.
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import dataclasses
from typing import Any, NamedTuple

from benchmarks import harness

harness.one_thread()

import numpy as np

from nerf2real.agents.distill.collecting.evaluator import other_trials
from nerf2real.agents.dmpo.policy.acting import Agent, run_episode, task_of
from nerf2real.agents.dmpo.policy.export import load_policy
from nerf2real.agents.environments.loading import evaluation_name, make_environment, trials_of

_RESAMPLES = 10_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to compare."""

  policies: tuple[str, ...]
  """Folders of exported policies; the first one is the reference."""
  env: str = "suite:nerf_nav"
  """Environment of their training."""
  trials: int = 27
  """Trials, spread over the protocol."""
  protocol: bool = False
  """Take the protocol's headings."""
  seed: int = 0
  """Of what the episodes draw."""


class Trial(NamedTuple):
  """How a policy did in one trial."""

  success: bool
  time: float  # to the goal [s]; NaN without success
  ending: str | None
  localisation_error: float  # m


def run_trials(folder: str, settings: Settings) -> list[Trial]:
  """Runs a policy's mean action through the trials."""
  environment = make_environment(evaluation_name(settings.env), seed=settings.seed)
  trials = trials_of(environment)
  if trials is None:
    raise SystemExit(f"{settings.env} has no protocol: expected a task of the suite.")
  chosen = trials.spread(settings.trials)
  trials.choose(chosen if settings.protocol else other_trials(chosen), seed=settings.seed)
  exported = load_policy(folder)
  agent = Agent(exported.policy, exported.layout, seed=settings.seed, deterministic=True)
  task: Any = task_of(environment)
  found = []
  for _ in chosen:
    figures = run_episode(agent, environment)
    error = figures.get("localisation_error", float("nan"))
    found.append(Trial(bool(task.success), task.success_time, task.ending, error))
  environment.close()
  return found


def summary(found: list[Trial]) -> dict[str, harness.Value]:
  """Figures of one policy."""
  endings = [trial.ending for trial in found if not trial.success]
  times = [trial.time for trial in found if trial.success]
  return {
    "success": harness.Rate(sum(trial.success for trial in found), len(found)),
    "median_time_s": float(np.median(times)) if times else float("nan"),
    "mean_time_s": float(np.mean(times)) if times else float("nan"),
    "collisions": endings.count("collision"),
    "falls": endings.count("fall"),
    "localisation_error_m": float(np.mean([trial.localisation_error for trial in found])),
  }


def difference(found: list[Trial], reference: list[Trial]) -> dict[str, harness.Value]:
  """Figures of a policy less those of the reference, trial by trial."""
  pairs = list(zip(found, reference, strict=True))
  times = np.array([a.time - b.time for a, b in pairs if a.success and b.success] or [np.nan])
  resampled = np.random.default_rng(0).choice(times, (_RESAMPLES, len(times))).mean(1)
  return {
    "won": sum(a.success and not b.success for a, b in pairs),
    "lost": sum(b.success and not a.success for a, b in pairs),
    "both": sum(a.success and b.success for a, b in pairs),
    "time_s": float(times.mean()),
    "low_s": float(np.percentile(resampled, 2.5)),
    "high_s": float(np.percentile(resampled, 97.5)),
  }


def main(settings: Settings) -> None:
  """Runs every policy and reports the differences."""
  found = {folder: run_trials(folder, settings) for folder in settings.policies}
  reference = found[settings.policies[0]]
  rows = {folder: summary(trials) for folder, trials in found.items()}
  rows |= {
    f"{folder} less {settings.policies[0]}": difference(found[folder], reference)
    for folder in settings.policies[1:]
  }
  details = {folder: [trial._asdict() for trial in trials] for folder, trials in found.items()}
  harness.finish("paired", rows, settings, seed=settings.seed, details=details)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
