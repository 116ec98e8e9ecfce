"""How a process joins a learner: description, environment, parameters, and failed episodes.

A process waits where the learner is away, and goes on when it is back. An episode that fails is
logged and another one begins; only several failures in a row end the process.
"""

import logging
import threading
from collections.abc import Callable
from typing import TypeVar

import dm_env
import numpy as np

from nerf2real.agents.dmpo import config as configs
from nerf2real.agents.dmpo.policy import acting
from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments.loading import make_environment
from nerf2real.agents.link.client import ActorLink, Grant
from nerf2real.core.serialization import from_plain

_log = logging.getLogger(__name__)
AWAY_POLL = 0.2  # s between questions while the learner does not answer
_MAX_FAILURES = 5  # episodes in a row

T = TypeVar("T")


class EpisodesFailed(RuntimeError):
  """Several episodes in a row ended in an exception."""


class Failures:
  """Counts episodes that end in an exception; several in a row end the process."""

  def __init__(self, link: ActorLink):
    """Reports to a link's learner."""
    self._link, self._count = link, 0

  def reset(self) -> None:
    """Counts an episode that ended well."""
    self._count = 0

  def add(self, error: Exception) -> None:
    """Logs and reports a failed episode.

    Raises:
      EpisodesFailed: It was the last of several in a row.
    """
    self._count += 1
    _log.error("An episode failed (%d in a row); another one begins.", self._count, exc_info=error)
    self._link.report({"failed_episode": 1})
    if self._count >= _MAX_FAILURES:
      raise EpisodesFailed(
        f"{self._count} episodes in a row failed, the last with {type(error).__name__}: {error}"
      ) from error


def wait_for(question: Callable[[], T | None], stop: threading.Event) -> T:
  """Returns the learner's answer to a question, repeated until there is one.

  Raises:
    InterruptedError: `stop` was set before.
  """
  while not stop.is_set():
    answer = question()
    if answer is not None:
      return answer
    stop.wait(AWAY_POLL)
  raise InterruptedError("Stopped while waiting for the learner.")


def make_known_environment(
  name: str, layout: Layout, *, seed: int, history: int = 1
) -> dm_env.Environment:
  """Returns an environment, whose layout must be the learner's.

  Args:
    name: see `agents/environments/loading.py`.
    layout: the learner's.
    seed: the environment's.
    history: observations stacked where the environment does not stack them itself.

  Raises:
    ValueError: It has another layout, or the name is unknown.
  """
  environment = make_environment(name, seed=seed, history=history)
  found = Layout.of(environment)
  if found != layout:
    raise ValueError(
      f"{name} is not the learner's here: expected {layout}, found {found}. Install the same "
      "release and scene."
    )
  return environment


class JoinedProcess:
  """What the processes of a run share: description, layout, failed episodes, a way to end."""

  def __init__(self, link: ActorLink):
    """Joins.

    Args:
      link: the process's link.
    """
    self.link = link
    self._stop = threading.Event()
    answer = wait_for(link.status, self._stop)
    self.description = answer["description"]
    self.layout = from_plain(self.description["layout"], Layout)
    # What seeds depend on besides: where the learner began, how many were in this one's place.
    self._beginning = (self.description["begin_steps"], answer["predecessors"])
    self._failures = Failures(link)

  def run(self) -> None:
    """Works until the run is over or `stop` is called."""
    raise NotImplementedError

  def stop(self) -> None:
    """Ends `run`; safe in a signal handler."""
    self._stop.set()


class PolicyProcess(JoinedProcess):
  """What actor and evaluator of the agent share: its environment, and the newest policy."""

  def __init__(
    self,
    link: ActorLink,
    *,
    environment: str,
    entropy: tuple[int, ...],
    deterministic: bool,
  ):
    """Joins.

    Args:
      link: the process's link.
      environment: entry of the run's description that names the environment.
      entropy: what the seeds of environment and actions are made from; for an actor, where the
        learner began and how many were in this one's place before are added.
      deterministic: takes the policy's mean instead of drawing.
    """
    super().__init__(link)
    self.config: configs.DmpoConfig = from_plain(self.description["config"], configs.DmpoConfig)
    if not deterministic:
      entropy = (*entropy, *self._beginning)
    self.seed, action_seed = (int(s) for s in np.random.SeedSequence(entropy).generate_state(2))
    self.environment = make_known_environment(
      self.description[environment], self.layout, seed=self.seed, history=self.config.history
    )
    self.agent = acting.Agent(
      Policy.of_network(wait_for(link.parameters, self._stop)[1], self.config.network),
      self.layout,
      seed=action_seed,
      deterministic=deterministic,
    )

  def _update_parameters(self, grant: Grant, *, hold: bool = False) -> None:
    # Another version, not a later one: a learner that resumed may have gone back.
    if grant["version"] != self.link.version or hold:
      answer = self.link.parameters(hold=hold)
      if answer is not None:
        self.agent.policy.update(answer[1])
