"""The actor's process: steps the policy in NumPy and sends trajectories to the learner."""

import logging
import time

import zenoh
from dm_control.rl import control

from nerf2real.agents.dmpo.policy import acting
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.processes.joining import AWAY_POLL, PolicyProcess
from nerf2real.agents.processes.timings import StageTimes

_log = logging.getLogger(__name__)
_POLL = 0.01  # s between questions while no credit is granted
_DRAIN = 3.0  # s to deliver what was made, at the end


class ActorProcess(PolicyProcess):
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
          self._failures.reset()
        except control.PhysicsError as error:
          _log.warning("The simulation failed and the episode was cut: %s", error)
          self._send(self._builder.finish())
          self.link.report({"physics_error": 1})
        except (MessageError, zenoh.ZError):  # the link failed, not the episode
          raise
        except Exception as error:
          self._send(self._builder.finish())
          self._failures.add(error)
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
      self.link.send(trajectory, steps=len(trajectory["reward"]) - 1)

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
        self._stop.wait(AWAY_POLL)
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
