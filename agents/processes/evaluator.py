"""The evaluator's process: measures the policy's mean action while a run goes on."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import zenoh

from nerf2real.agents.dmpo.policy import acting
from nerf2real.agents.environments.loading import trials_of
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.processes.joining import AWAY_POLL, PolicyProcess
from nerf2real.core.intervals import clopper_pearson

_EPISODES = 5  # of an evaluation, where there is no protocol


class EvaluatorProcess(PolicyProcess):
  """Measures the policy's mean action at regular numbers of environment steps.

  Where the task has success, a policy that looks as good as the best so far is measured again on
  fresh trials, and these alone count: the maximum of noisy figures is biased.
  """

  def __init__(self, link: ActorLink, *, seed: int):
    """Joins the run that the link leads to.

    Args:
      link: a link of the role "evaluator".
      seed: of the environment. Trials of a protocol are the same at every evaluation; episodes of
        other environments go on.
    """
    super().__init__(
      link, environment="evaluation_environment", entropy=(seed,), deterministic=True
    )
    self._trials = trials_of(self.environment)
    wanted = self.description["evaluation_episodes"]
    default = _EPISODES if self._trials is None else (self._trials.count + 1) // 2
    self._episodes = default if wanted is None else wanted
    # The trials that evaluate, and others that confirm, with other draws where they are too few.
    self._subsets: tuple[list[Any], list[Any]] = ([], [])
    if self._trials is not None:
      self._episodes = min(self._episodes, self._trials.count)
      first = self._trials.spread(self._episodes)
      self._subsets = (first, self._trials.spread(self._episodes, without=first))

  def run(self) -> None:
    """Evaluates until the run is over or `stop` is called.

    Raises:
      EpisodesFailed: several evaluations in a row ended in an exception.
    """
    period = self.description["evaluation_period"]
    done_at = -period
    while not self._stop.is_set():
      grant = self.link.request(0)
      if grant is None:
        self._stop.wait(AWAY_POLL)
        continue
      steps = grant["steps"]
      if grant["stop"]:
        return
      if steps // period > done_at // period:
        done_at = steps
        self._update_parameters(grant, hold=True)
        try:
          self._evaluate(steps)
          self._failures.reset()
        except (MessageError, zenoh.ZError):
          raise
        except Exception as error:
          self._failures.add(error)
      self._stop.wait(AWAY_POLL)

  def _evaluate(self, steps: int) -> None:
    figures = self._measure(self._subsets[0], seed=self.seed)
    if figures is None:
      return
    about = {"version": self.link.version, "at_steps": steps}
    self.link.report(figures | about | {"confirmation": 0})
    if "success" not in figures or not self._rivals_the_best(figures):
      return
    confirmed = self._measure(self._subsets[1], seed=(self.seed + 1 + steps) % 2**32)
    if confirmed is not None:
      self.link.report(confirmed | about | {"confirmation": 1})

  def _rivals_the_best(self, figures: dict[str, Any]) -> bool:
    answer = self.link.status()
    best = None if answer is None else answer["status"].get("best_success")
    if answer is None or best is None:
      return True
    return (figures["success"], figures["return"]) > (best, answer["status"]["best"])

  def _measure(self, trials: list[Any], *, seed: int) -> dict[str, Any] | None:
    """Runs an evaluation's episodes; None if it was stopped."""
    results: list[dict[str, Any]] = []
    if self._trials is not None:
      self._trials.choose(trials, seed=seed)
    while len(results) < self._episodes:
      if self._stop.is_set():
        return None
      results.append(acting.run_episode(self.agent, self.environment))
    return summary(results)


def summary(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
  """Means of the figures of episodes; success with its exact interval."""
  count = len(results)
  figures = {name: float(np.mean([r[name] for r in results if name in r])) for name in results[0]}
  figures["length"] = figures.pop("steps")
  if "success" in figures:
    interval = clopper_pearson(round(figures["success"] * count), count)
    figures |= {"success_low": interval.low, "success_high": interval.high}
  return figures | {"episodes": count}
