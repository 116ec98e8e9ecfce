"""The collector: runs labelled episodes for a learner until the run is over.

A process of its own; what to run and the newest student come from the learner over the link. An
episode is sent whole when it ends, and kept until the learner has acknowledged it.
"""

import logging
import time

import numpy as np
import zenoh

from nerf2real.agents.distill.collecting.episodes import EpisodeRunner
from nerf2real.agents.distill.schedule import BORROWED, may_collect, mixture_at, push_level, pushed
from nerf2real.agents.distill.settings import DistillSettings
from nerf2real.agents.distill.teacher import make_teacher
from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.processes.joining import AWAY_POLL, JoinedProcess, make_known_environment
from nerf2real.core.serialization import from_plain

_log = logging.getLogger(__name__)
_DRAIN = 5.0  # s to deliver what was made, at the end
_MAX_UNDELIVERED = 8  # episodes in the outbox, from which the collector waits for the learner


class Collector(JoinedProcess):
  """Runs labelled episodes for a learner until the run is over."""

  def __init__(self, link: ActorLink, *, seed: int, index: int):
    """Joins the run that the link leads to.

    Args:
      link: an actor's link.
      seed: the run's; with the index, where the learner began and how many were in this one's place
        before, it makes the seeds of environment and mixture.
      index: this collector's number in the run.
    """
    super().__init__(link)
    self._settings = from_plain(self.description["settings"], DistillSettings)
    self._seeds = np.random.SeedSequence((seed, index, *self._beginning))
    self._policy: Policy | None = None
    self._begun: int | None = self.description["begun"]
    self._level: tuple[float, float] | None = None
    self._runner: EpisodeRunner | None = None

  def run(self) -> None:
    """Collects until the run is over or `stop` is called.

    Raises:
      EpisodesFailed: several episodes in a row ended in an exception.
    """
    try:
      while not self._stop.is_set():
        frames = self._ask()
        if frames is None:
          break
        try:
          self._episode(frames)
          self._failures.reset()
        except (MessageError, zenoh.ZError):  # the link failed, not the episode
          raise
        except Exception as error:
          self._failures.add(error)
    finally:
      self.link.drain(timeout=_DRAIN)

  def _ask(self) -> int | None:
    """Fetches the newest student; returns the run's frames, or None at its end."""
    while not self._stop.is_set():
      grant = self.link.request(0)
      if grant is None or self.link.outbox.size > _MAX_UNDELIVERED:
        self.link.flush()
        self._stop.wait(AWAY_POLL)
        continue
      if grant["stop"]:
        return None
      if grant["version"] != self.link.version:
        answer = self.link.parameters()
        if answer is not None:
          self._policy = Policy.of_network(answer[1], self._settings.agent.network)
          if self._begun is None and answer[0] > BORROWED:
            self._begun = int(grant["steps"])
      if may_collect(self._settings, int(grant["steps"]), begun=self._begun):
        return int(grant["steps"])
      self.link.flush()
      self._stop.wait(AWAY_POLL)
    return None

  def _episode(self, frames: int) -> None:
    level = push_level(self._settings, frames)
    if self._runner is None or level != self._level:
      self._runner, self._level = self._make_runner(level), level
    begin = time.perf_counter()
    mixture = mixture_at(
      self._settings.mixture, frames, begun=self._begun, is_borrowed=self._policy is not None
    )
    arrays, figures = self._runner.run(self._policy, mixture)
    steps = len(arrays["state"])
    self.link.send(arrays, steps=steps)
    rates = {"steps_per_second": steps / (time.perf_counter() - begin), "push_force": level[1]}
    about = {"teacher_share": mixture.teacher, "belief_share": mixture.belief}
    self.link.report(figures | rates | about | self._runner.times.take(steps))

  def _make_runner(self, level: tuple[float, float]) -> EpisodeRunner:
    environment_seed, mixture_seed = (int(s) for s in self._seeds.spawn(1)[0].generate_state(2))
    environment = make_known_environment(
      pushed(self._settings.environment, level), self.layout, seed=environment_seed
    )
    return EpisodeRunner(
      environment,
      self.layout,
      teacher=make_teacher(self._settings.teacher, task_of(environment).scene),
      settings=self._settings.mixture,
      rng=np.random.default_rng(mixture_seed),
    )
