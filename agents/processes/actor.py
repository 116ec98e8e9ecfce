"""The processes beside the learner: the actor, which makes trajectories, and the evaluator.

Both learn from the learner what to run, and step the policy in NumPy. They wait where the learner
is away, and go on when it is back. An episode that fails is logged and another one begins; only
several failures in a row end the process.
"""

import logging
import threading
import time
from typing import Any

import dm_env
import numpy as np
import zenoh
from dm_control.rl import control

from nerf2real.agents.dmpo import config as configs
from nerf2real.agents.dmpo.policy import acting
from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments.loading import make_environment, trials_of
from nerf2real.agents.environments.trials import clopper_pearson
from nerf2real.agents.link.client import ActorLink, Grant
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.processes.timings import StageTimes
from nerf2real.core.serialization import from_plain

_log = logging.getLogger(__name__)
_POLL = 0.01  # s between questions while no credit is granted
_AWAY_POLL = 0.2  # s between questions while the learner does not answer
_DRAIN = 3.0  # s to deliver what was made, at the end
_MAX_FAILURES = 5  # episodes in a row
_EPISODES = 5  # of an evaluation, where there is no protocol


class EpisodesFailed(RuntimeError):
  """Several episodes in a row ended in an exception."""


class _Process:
  """What actor and evaluator share: joining, parameters, the environment, failing episodes."""

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
    self.link = link
    self._stop = threading.Event()
    answer = self._describe()
    self.description = description = answer["description"]
    self.config: configs.DmpoConfig = from_plain(description["config"], configs.DmpoConfig)
    self.layout = from_plain(description["layout"], Layout)
    if not deterministic:
      entropy = (*entropy, description["begin_steps"], answer["predecessors"])
    self.seed, action_seed = (int(s) for s in np.random.SeedSequence(entropy).generate_state(2))
    self.environment: dm_env.Environment = make_environment(
      description[environment], seed=self.seed, history=self.config.history
    )
    found = Layout.of(self.environment)
    if found != self.layout:
      raise ValueError(
        f"{description[environment]} is not the learner's here: expected {self.layout}, found "
        f"{found}. Install the same release and scene."
      )
    self.agent = acting.Agent(
      Policy(
        self._first_parameters(),
        init_stddev=self.config.network.init_stddev,
        min_stddev=self.config.network.min_stddev,
      ),
      self.layout,
      seed=action_seed,
      deterministic=deterministic,
    )
    self._failures = 0  # in a row

  def stop(self) -> None:
    """Ends `run`; safe in a signal handler."""
    self._stop.set()

  def _describe(self) -> dict[str, Any]:
    while not self._stop.is_set():
      answer = self.link.status()
      if answer is not None:
        return answer
      self._stop.wait(_AWAY_POLL)
    raise InterruptedError("Stopped while waiting for the learner.")

  def _first_parameters(self) -> dict[str, np.ndarray]:
    while not self._stop.is_set():
      answer = self.link.parameters()
      if answer is not None:
        return answer[1]
      self._stop.wait(_AWAY_POLL)
    raise InterruptedError("Stopped while waiting for the learner.")

  def _update_parameters(self, grant: Grant, *, hold: bool = False) -> None:
    # Another version, not a later one: a learner that resumed may have gone back.
    if grant["version"] != self.link.version or hold:
      answer = self.link.parameters(hold=hold)
      if answer is not None:
        self.agent.policy.update(answer[1])

  def _failed(self, error: Exception) -> None:
    """Logs an exception in an episode; raises EpisodesFailed after several in a row."""
    self._failures += 1
    _log.error(
      "An episode failed (%d in a row); another one begins.", self._failures, exc_info=error
    )
    self.link.report({"failed_episode": 1})
    if self._failures >= _MAX_FAILURES:
      raise EpisodesFailed(
        f"{self._failures} episodes in a row failed, the last with {type(error).__name__}: {error}"
      ) from error


class ActorProcess(_Process):
  """Runs episodes with drawn actions and sends every transition once."""

  def __init__(self, link: ActorLink, *, seed: int, index: int = 0):
    """Joins the run that the link leads to.

    Args:
      link: an actor's link.
      seed: the run's; with the index it makes the seeds of the environment and of the actions.
      index: this actor's number in the run.
    """
    super().__init__(link, environment="environment", entropy=(seed, index), deterministic=False)
    self._length = self.config.trajectory_length
    self._builder = acting.TrajectoryBuilder(self._length)
    self._credits = 0
    self._times = StageTimes()
    self._task = acting.task_of(self.environment)

  def run(self) -> None:
    """Acts until the run is over or `stop` is called.

    Raises:
      EpisodesFailed: several episodes in a row ended in an exception.
    """
    try:
      while not self._stop.is_set():
        try:
          self._episode()
          self._failures = 0
        except control.PhysicsError as error:
          _log.warning("The simulation failed and the episode was cut: %s", error)
          self._send(self._builder.finish())
          self.link.report({"physics_error": 1})
        except (MessageError, zenoh.ZError):  # the link failed, not the episode
          raise
        except Exception as error:
          self._send(self._builder.finish())
          self._failed(error)
    finally:
      self._send(self._builder.finish())
      self.link.drain(timeout=_DRAIN)

  def _episode(self) -> None:
    rendered = self._render_time()
    with self._times.stage("env"):
      timestep = self.environment.reset()
    self.agent.reset()
    observation = self.layout.flatten(timestep.observation)
    self._builder.start(observation, self.agent.state)
    total, steps = 0.0, 0
    success: bool | None = None
    while not timestep.last():
      if not self._credits:
        with self._times.stage("waiting"):
          if not self._acquire():
            return
      with self._times.stage("inference"):
        action = self.agent.act(observation)
      with self._times.stage("env"):
        timestep = self.environment.step(action)
      self._credits -= 1
      reward = float(timestep.reward or 0.0)
      discount = 1.0 if timestep.discount is None else float(timestep.discount)
      observation = self.layout.flatten(timestep.observation)
      self._send(
        self._builder.add(
          action,
          reward,
          discount,
          observation=observation,
          state=self.agent.state,
          last=timestep.last(),
        )
      )
      total, steps = total + reward, steps + 1
      success = acting.episode_success(self.environment)
    figures = acting.episode_figures(self.agent, total=total, steps=steps, success=success)
    figures["length"] = figures.pop("steps")
    self._times.move(self._render_time() - rendered, source="env", to="render")
    self.link.report(figures | self._times.take(steps))

  def _render_time(self) -> float:
    return getattr(self._task, "render_time", 0.0)

  def _send(self, trajectory: acting.Trajectory | None) -> None:
    if trajectory is not None:
      self.link.send(trajectory)

  def _acquire(self) -> bool:
    """Waits for credits; returns whether to go on."""
    silent_since: float | None = None
    while not self._stop.is_set():
      self.link.flush()
      held = self._builder.steps
      grant = self.link.request(self._length - 1 - held, held=held)
      if grant is None:
        if silent_since is None:
          silent_since = time.monotonic()
          _log.warning("The learner does not answer; waiting.")
        self._stop.wait(_AWAY_POLL)
        continue
      if silent_since is not None:
        _log.warning("The learner is back after %.0f s.", time.monotonic() - silent_since)
        silent_since = None
      if grant["stop"]:
        self.stop()
        return False
      self._update_parameters(grant)
      if grant["granted"]:
        self._credits = grant["granted"]
        return True
      if grant["ending"]:  # no more credits will come: the learner waits for what is here
        self._send(self._builder.finish())
      self._stop.wait(_POLL)
    return False


class EvaluatorProcess(_Process):
  """Measures the policy's mean action at regular numbers of environment steps.

  Where the task knows success, a policy that looks as good as the best so far is measured again on
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
    # The trials that evaluate, and others that confirm.
    self._subsets = [
      [] if self._trials is None else self._trials.spread(self._episodes, shift=s) for s in (0, 1)
    ]

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
        self._stop.wait(_AWAY_POLL)
        continue
      steps = grant["steps"]
      if grant["stop"]:
        return
      if steps // period > done_at // period:
        done_at = steps
        self._update_parameters(grant, hold=True)
        try:
          self._evaluate(steps)
          self._failures = 0
        except (MessageError, zenoh.ZError):
          raise
        except Exception as error:
          self._failed(error)
      self._stop.wait(_AWAY_POLL)

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
    count = len(trials) or self._episodes
    while len(results) < count:
      if self._stop.is_set():
        return None
      results.append(acting.run_episode(self.agent, self.environment))
    figures = {name: float(np.mean([r[name] for r in results if name in r])) for name in results[0]}
    figures["length"] = figures.pop("steps")
    if "success" in figures:
      interval = clopper_pearson(round(figures["success"] * count), count)
      figures |= {"success_low": interval.low, "success_high": interval.high}
    return figures | {"episodes": count}
