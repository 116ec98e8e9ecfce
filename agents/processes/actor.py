"""The processes beside the learner: the actor, which makes trajectories, and the evaluator.

Both learn from the learner what to run, and step the policy in NumPy. They wait where the learner
is away, and go on when it is back.
"""

import logging
import threading
import time
from typing import Any

import dm_env
import numpy as np
from dm_control.rl import control

from nerf2real.agents.dmpo import acting
from nerf2real.agents.dmpo import config as configs
from nerf2real.agents.dmpo.inference import Policy
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.link.client import ActorLink, Grant
from nerf2real.agents.processes.environments import make_environment
from nerf2real.core.serialization import from_plain

_log = logging.getLogger(__name__)
_POLL = 0.01  # s between questions while no credit is granted
_AWAY_POLL = 0.2  # s between questions while the learner does not answer
_DRAIN = 3.0  # s to deliver what was made, at the end


class _Process:
  """What actor and evaluator share: joining, parameters, the environment."""

  def __init__(self, link: ActorLink, *, seed: int, deterministic: bool):
    self.link = link
    self._stop = threading.Event()
    description = self._describe()
    self.description = description
    self.config: configs.DmpoConfig = from_plain(description["config"], configs.DmpoConfig)
    self.layout = from_plain(description["layout"], Layout)
    self.environment: dm_env.Environment = make_environment(
      description["environment"], seed=seed, history=self.config.history
    )
    found = Layout.of(self.environment)
    if found != self.layout:
      raise ValueError(
        f"{description['environment']} is not the learner's here: expected {self.layout}, found "
        f"{found}. Install the same release and scene."
      )
    self.agent = acting.Agent(
      Policy(
        self._first_parameters(),
        init_stddev=self.config.network.init_stddev,
        min_stddev=self.config.network.min_stddev,
      ),
      self.layout,
      seed=seed,
      deterministic=deterministic,
    )

  def stop(self) -> None:
    """Ends `run`; safe in a signal handler."""
    self._stop.set()

  def _describe(self) -> dict[str, Any]:
    while not self._stop.is_set():
      answer = self.link.status()
      if answer is not None:
        return answer["description"]
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


class ActorProcess(_Process):
  """Runs episodes with drawn actions and sends every transition once."""

  def __init__(self, link: ActorLink, *, seed: int):
    """Joins the run that the link leads to.

    Args:
      link: an actor's link.
      seed: of the environment and of the actions.
    """
    super().__init__(link, seed=seed, deterministic=False)
    self._length = self.config.trajectory_length
    self._builder = acting.TrajectoryBuilder(self._length)
    self._credits = 0

  def run(self) -> None:
    """Acts until the run is over or `stop` is called."""
    while not self._stop.is_set():
      try:
        self._episode()
      except control.PhysicsError as error:
        _log.warning("The simulation failed and the episode was cut: %s", error)
        self._send(self._builder.finish())
        self.link.report({"physics_error": 1})
    self._send(self._builder.finish())
    self.link.drain(timeout=_DRAIN)

  def _episode(self) -> None:
    timestep = self.environment.reset()
    self.agent.reset()
    observation = self.layout.flatten(timestep.observation)
    self._builder.start(observation, self.agent.state)
    total, steps = 0.0, 0
    success: bool | None = None
    while not timestep.last():
      if not self._credits and not self._acquire():
        return
      action = self.agent.act(observation)
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
    self.link.report(figures)

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
  """Measures the policy's mean action at regular numbers of environment steps."""

  def __init__(self, link: ActorLink, *, seed: int):
    """Joins the run that the link leads to.

    Args:
      link: a link of the role "evaluator".
      seed: of the environment; each evaluation goes on with its next episodes.
    """
    super().__init__(link, seed=seed, deterministic=True)

  def run(self) -> None:
    """Evaluates until the run is over or `stop` is called."""
    period, episodes = (
      self.description["evaluation_period"],
      self.description["evaluation_episodes"],
    )
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
        self._evaluate(episodes, steps)
      self._stop.wait(_AWAY_POLL)

  def _evaluate(self, episodes: int, steps: int) -> None:
    results: list[dict[str, Any]] = []
    while len(results) < episodes and not self._stop.is_set():
      results.append(acting.run_episode(self.agent, self.environment))
    if not results:
      return
    figures = {name: float(np.mean([r[name] for r in results if name in r])) for name in results[0]}
    figures["length"] = figures.pop("steps")
    self.link.report(
      figures | {"episodes": len(results), "version": self.link.version, "at_steps": steps}
    )
