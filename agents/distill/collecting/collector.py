"""The collector: runs labelled episodes for a learner until the run is over.

A process of its own; what to run and the newest student come from the learner over the link. An
episode is sent whole when it ends, and kept until the learner has acknowledged it.
"""

import logging
import threading
import time

import numpy as np

from nerf2real.agents.distill.collecting.episodes import EpisodeRunner
from nerf2real.agents.distill.schedule import may_collect, mixture_at, push_level, pushed
from nerf2real.agents.distill.settings import DistillSettings
from nerf2real.agents.distill.teacher import make_teacher
from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.processes.joining import AWAY_POLL, Failures, make_known_environment, wait_for
from nerf2real.core.serialization import from_plain

_log = logging.getLogger(__name__)
_DRAIN = 5.0  # s to deliver what was made, at the end
_MAX_UNDELIVERED = 8  # episodes in the outbox, from which the collector waits for the learner


class Collector:
  """Runs labelled episodes for a learner until the run is over."""

  def __init__(self, link: ActorLink, *, seed: int, index: int):
    """Joins the run that the link leads to.

    Args:
      link: an actor's link.
      seed: the run's; with the index, where the learner began and how many were in this one's place
        before, it makes the seeds of environment and mixture.
      index: this collector's number in the run.
    """
    self._link = link
    self._stop = threading.Event()
    answer = wait_for(link.status, self._stop)
    description = answer["description"]
    self._settings = from_plain(description["settings"], DistillSettings)
    self._layout = from_plain(description["layout"], Layout)
    entropy = (seed, index, description["begin_frames"], answer["predecessors"])
    self._seeds = np.random.SeedSequence(entropy)
    self._policy: Policy | None = None
    self._begun: int | None = description["begun"]
    self._level: tuple[float, float] | None = None
    self._runner: EpisodeRunner | None = None

  def stop(self) -> None:
    """Ends `run`; safe in a signal handler."""
    self._stop.set()

  def run(self) -> None:
    """Collects until the run is over or `stop` is called.

    Raises:
      EpisodesFailed: several episodes in a row ended in an exception.
    """
    failures = Failures(self._link)
    try:
      while not self._stop.is_set():
        frames = self._ask()
        if frames is None:
          break
        try:
          self._episode(frames)
          failures.reset()
        except Exception as error:
          failures.add(error)
    finally:
      self._link.drain(timeout=_DRAIN)

  def _ask(self) -> int | None:
    """Fetches the newest student; returns the run's frames, or None at its end."""
    while not self._stop.is_set():
      grant = self._link.request(0)
      if grant is None or self._link.outbox.size > _MAX_UNDELIVERED:
        self._link.flush()
        self._stop.wait(AWAY_POLL)
        continue
      if grant["stop"]:
        return None
      if grant["version"] != self._link.version:
        answer = self._link.parameters()
        if answer is not None:
          self._policy = student_policy(answer[1], self._settings)
          self._begun = grant["steps"] if self._begun is None else self._begun
      if may_collect(self._settings, int(grant["steps"]), begun=self._begun):
        return int(grant["steps"])
      self._link.flush()
      self._stop.wait(AWAY_POLL)
    return None

  def _episode(self, frames: int) -> None:
    level = push_level(self._settings, frames)
    if self._runner is None or level != self._level:
      self._runner, self._level = self._make_runner(level), level
    begin = time.perf_counter()
    mixture = mixture_at(self._settings.mixture, frames, begun=self._begun)
    arrays, figures = self._runner.run(self._policy, mixture)
    steps = len(arrays["state"])
    self._link.send(arrays, steps=steps)
    rates = {"steps_per_second": steps / (time.perf_counter() - begin), "push_force": level[1]}
    about = {"teacher_share": mixture.teacher, "belief_share": mixture.belief}
    self._link.report(figures | rates | about | self._runner.times.take(steps))

  def _make_runner(self, level: tuple[float, float]) -> EpisodeRunner:
    environment_seed, mixture_seed = (int(s) for s in self._seeds.spawn(1)[0].generate_state(2))
    environment = make_known_environment(
      pushed(self._settings.environment, level), self._layout, seed=environment_seed
    )
    return EpisodeRunner(
      environment,
      self._layout,
      teacher=make_teacher(self._settings.teacher, task_of(environment).scene),
      settings=self._settings.mixture,
      rng=np.random.default_rng(mixture_seed),
    )


def student_policy(parameters: dict[str, np.ndarray], settings: DistillSettings) -> Policy:
  """Returns the policy that runs a student's served parameters."""
  network = settings.agent.network
  return Policy(parameters, init_stddev=network.init_stddev, min_stddev=network.min_stddev)
