"""The evaluator of a distillation: success rate of the student alone, on trials kept for it.

Its trials are those of the protocol with the robot turned half way between the protocol's headings
and with other draws; what is published is measured on the protocol itself (`launch/evaluate.py`).
"""

import time
from typing import Any

import numpy as np
import zenoh

from nerf2real.agents.distill.settings import DistillSettings
from nerf2real.agents.dmpo.policy.acting import Agent, run_episode, task_of
from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.agents.environments.loading import (
  evaluation_name,
  make_environment,
  trials_of,
)
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.processes.evaluator import summary
from nerf2real.agents.processes.joining import JoinedProcess
from nerf2real.core.serialization import from_plain

_POLL = 1.0  # s
_TURN = np.pi / 3  # rad: half of the protocol's 120 degrees between headings
_SEED_SHIFT = 1_000  # beyond the seeds of the protocol's trials


def other_trials(trials: list[Any]) -> list[Any]:
  """Returns trials that differ from those given in heading and draws."""
  turned = "yaw" if hasattr(trials[0], "yaw") else "robot_yaw"
  return [
    trial._replace(**{turned: getattr(trial, turned) + _TURN, "seed": trial.seed + _SEED_SHIFT})
    for trial in trials
  ]


class Evaluator(JoinedProcess):
  """Measures the newest student at regular times."""

  def __init__(self, link: ActorLink, *, seed: int):
    """Joins the run that the link leads to.

    Args:
      link: a link of the role "evaluator".
      seed: of what the episodes draw.
    """
    super().__init__(link)
    self._seed = seed
    self._settings = from_plain(self.description["settings"], DistillSettings)
    self._environment = make_environment(evaluation_name(self._settings.environment), seed=seed)
    found = trials_of(self._environment)
    if found is None:
      raise ValueError(f"{self._settings.environment} has no protocol to evaluate on.")
    self._trials = found
    self._chosen = other_trials(found.spread(self._settings.evaluation_trials))

  def run(self) -> None:
    """Evaluates until the run is over or `stop` is called.

    Raises:
      EpisodesFailed: several evaluations in a row ended in an exception.
    """
    due = -np.inf
    while not self._stop.is_set():
      grant = self.link.request(0)
      if grant is not None and grant["stop"]:
        return
      # Version 0: no student yet; that of the last evaluation: none since, as while the encoder
      # learns again.
      fresh = grant is not None and grant["version"] not in (0, self.link.version)
      if fresh and time.monotonic() >= due:
        due = time.monotonic() + self._settings.evaluation_period
        answer = self.link.parameters()
        if answer is not None:
          self._try_to_evaluate(*answer)
      self._stop.wait(_POLL)

  def _try_to_evaluate(self, version: int, parameters: dict[str, np.ndarray]) -> None:
    try:
      self._evaluate(version, parameters)
      self._failures.reset()
    except (MessageError, zenoh.ZError):  # the link failed, not the episode
      raise
    except Exception as error:
      self._failures.add(error)

  def _evaluate(self, version: int, parameters: dict[str, np.ndarray]) -> None:
    policy = Policy.of_network(parameters, self._settings.agent.network)
    agent = Agent(policy, self.layout, seed=self._seed, deterministic=True)
    self._trials.choose(self._chosen, seed=self._seed)
    results, times, endings = [], [], []
    for _ in self._chosen:
      if self._stop.is_set():
        return
      results.append(run_episode(agent, self._environment))
      task = task_of(self._environment)
      endings.append(task.ending)
      if task.success:
        times.append(task.success_time)
    self.link.report(
      summary(results)
      | {
        "version": version,
        "median_time": float(np.median(times)) if times else None,
        "falls": endings.count("fall"),
        "collisions": endings.count("collision"),
      }
    )
