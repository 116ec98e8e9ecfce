"""The learner's process: replay, updates, parameters for the actors, checkpoints, logs.

Everything that waits for the accelerator happens in the thread that calls `Learner.run`; the link's
threads only fill the replay and answer questions.
"""

import collections
import logging
import threading
import time
from typing import Any

import jax
import numpy as np

from nerf2real.agents.dmpo import config as configs
from nerf2real.agents.dmpo import learning, scaling, training_state
from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments.loading import evaluation_name, make_environment
from nerf2real.agents.link import sessions
from nerf2real.agents.link.limiter import RateLimiter
from nerf2real.agents.link.server import LearnerLink
from nerf2real.agents.processes import beginning
from nerf2real.agents.processes.best_policy import BestPolicy
from nerf2real.agents.processes.checkpoints import BEST, CheckpointError, Checkpoints
from nerf2real.agents.processes.experience import Experience
from nerf2real.agents.processes.logs import MetricsLog
from nerf2real.agents.processes.settings import RunSettings
from nerf2real.agents.processes.timings import Periods, Rates, StageTimes
from nerf2real.core.serialization import to_plain

_log = logging.getLogger(__name__)
_RECENT_EPISODES = 20  # over which returns are averaged in the status
_STATUS_PERIOD = 0.5  # s
_ROUTER_TIMEOUT = 60.0  # s to wait for a router that is to be joined
_SCALING_TRAJECTORIES = 1024  # that the scaling of observations is measured on


class LearnerError(RuntimeError):
  """The run cannot go on; the message is one line for the user."""


class Learner:
  """Learns until the run is over or `stop` is called."""

  def __init__(
    self,
    settings: RunSettings,
    config: configs.DmpoConfig,
    *,
    endpoint: str,
    link: sessions.LinkSettings,
    resume: bool = False,
    join: bool = False,
  ):
    """Prepares the state and starts serving.

    Args:
      settings: the run's settings.
      config: the agent's settings.
      endpoint: where to listen, such as tcp/127.0.0.1:7447, or the router to join.
      link: the link's settings.
      resume: continues from the newest checkpoint.
      join: joins the router at the endpoint instead of being one.

    Raises:
      ValueError: the folder holds a run that is not resumed, or settings do not fit together.
      CheckpointError: there is no checkpoint to resume from, or it does not fit the settings.
      LinkError: the endpoint is taken, or open to the network without users.
    """
    self._settings, self._config = settings, config
    self._stop = threading.Event()
    settings.run.mkdir(parents=True, exist_ok=True)
    self._checkpoints = Checkpoints(settings.run / "checkpoints")
    if self._checkpoints.list() and not resume:
      raise ValueError(
        f"{settings.run} holds a run: add --resume, or name another folder with --run."
      )
    environment = make_environment(settings.environment, seed=0, history=config.history)
    self.layout = Layout.of(environment)
    first_action = beginning.first_action(environment, config, settings.environment)
    environment.close()
    self._learning = learning.make_learning(config, self.layout, first_action=first_action)
    self._state = jax.jit(self._learning.init)(jax.random.PRNGKey(settings.seed))
    self._begin, self._seconds_before = time.monotonic(), 0.0
    self._init_from = "" if settings.init_from is None else str(settings.init_from)
    info: dict[str, Any] = {}
    if resume:
      self._state, info = self._checkpoints.restore(self._state)
      self._seconds_before = info.get("seconds", 0.0)
      self._init_from = info.get("init_from", "")
    elif settings.init_from is not None:
      self._state = beginning.with_exported_policy(settings.init_from, self._state, self.layout)
    self._best = BestPolicy(info)
    # Remembered: reading it from the state would wait for the update that the device works on.
    self._scaled = scaling.is_measured(self._state.scaling)
    beginning.check_beginning(config, self._init_from)
    self._experience = Experience(
      settings, config, layout=self.layout, policy=self._state.policy, resume=resume
    )
    self.replay = self._experience.replay
    limiter = beginning.make_limiter(
      settings, config, replay=self.replay, info=info, updates=int(self._state.steps)
    )
    self._log = MetricsLog(settings.run)
    self._random = np.random.default_rng((settings.seed, int(self._state.steps)))
    self._recent: collections.deque[dict[str, Any]] = collections.deque(maxlen=_RECENT_EPISODES)
    self._rates = Rates(limiter.steps, limiter.updates)
    self._periods = Periods()
    self._problem = ""
    self._times, self._timed_updates = StageTimes(), limiter.updates
    if join:
      self._session = sessions.connect(endpoint, link, timeout=_ROUTER_TIMEOUT)
    else:
      self._session = sessions.listen(endpoint, link)
    self.link = LearnerLink(
      self._session,
      link,
      limiter=limiter,
      insert=self._experience.insert,
      known=self.replay.origins(),
      description={
        "environment": settings.environment,
        "config": to_plain(config),
        "layout": to_plain(self.layout),
        "seed": settings.seed,
        "begin_steps": limiter.steps,
        "evaluation_environment": settings.evaluation_env or evaluation_name(settings.environment),
        "evaluation_period": settings.evaluation_period,
        "evaluation_episodes": settings.evaluation_episodes,
      },
    )
    self._publish()
    if not resume:  # so that a learner that dies early has something to go on from
      self.save()

  def stop(self) -> None:
    """Ends `run` after the present update; safe in a signal handler."""
    self._stop.set()

  @property
  def problem(self) -> str:
    """What could not be written when it was last tried; empty if all could."""
    return self._problem

  @property
  def limiter(self) -> RateLimiter:
    """The run's counters; other threads write to them."""
    return self.link.limiter

  def run(self) -> None:
    """Learns until the run is over, then saves and closes.

    Raises:
      LearnerError: trajectories can no longer be taken in, such as on a full disk.
    """
    metrics: dict[str, Any] = {}
    self.link.set_status(self._status())
    try:
      while not self._stop.is_set():
        with self.link.lock:
          due, finished = self._update_due, self.limiter.finished
        if finished or self._time_is_up():
          break
        if self.link.failure:
          raise LearnerError(f"No trajectory can be taken in any more: {self.link.failure}")
        if due:
          metrics = self._update(metrics)
        else:
          with self._times.stage("waiting"):
            self._stop.wait(0.002)
        if self._periods.due("status", _STATUS_PERIOD):
          self._take_metrics()
          self.link.set_status(self._status())
        if metrics and self._periods.due("log", self._settings.log_period):
          self._write_own(metrics)
        if self._periods.due("save", self._settings.checkpoint_period):
          self.save()
    finally:
      self._finish(metrics)

  @property
  def _seconds(self) -> float:
    """Time of the run so far, over all its parts [s]."""
    return self._seconds_before + time.monotonic() - self._begin

  def _time_is_up(self) -> bool:
    minutes = self._settings.minutes
    return minutes is not None and self._seconds >= 60 * minutes

  @property
  def _warms_up(self) -> bool:
    """Whether the critic learns alone."""
    return self.limiter.updates < self._config.critic_warmup

  @property
  def _update_due(self) -> bool:
    return self.limiter.filled if self._warms_up else self.limiter.update_due

  def _update(self, previous: dict[str, Any]) -> dict[str, Any]:
    if not self._scaled:
      self._measure_scaling()
    warms_up = self._warms_up
    with self._times.stage("sampling"):
      batch = self._experience.sample(self._random)
      if self._config.student_kl:
        weight = learning.student_weight(self._config, self.limiter.updates, self._mean("return"))
        batch["student_weight"] = np.float32(weight)
    with self._times.stage("update"):
      if previous:  # at most one update waits behind the one that the device works on
        jax.block_until_ready(previous["loss"])
      update = self._learning.update_critic if warms_up else self._learning.update
      self._state, metrics = update(self._state, batch)
    with self.link.lock:
      self.limiter.updated(paid=not warms_up)
      updates = self.limiter.updates
    if updates % self._config.target_actor_period == 0:
      self._publish()
    return metrics

  def _measure_scaling(self) -> None:
    """Measures the scaling of the observations on what has filled the replay."""
    sample = self.replay.sample(
      np.random.default_rng(self._settings.seed),
      _SCALING_TRAJECTORIES,
      names=(*scaling.NAMES, "last"),
    )
    self._scaled = True
    seen = np.arange(self._config.trajectory_length) <= sample["last"][:, None]
    scales = scaling.measure({name: sample[name][seen] for name in scaling.NAMES}, self.layout)
    self._state = training_state.with_scaling(
      self._state, scales, keep_policy=bool(self._init_from)
    )

  def _publish(self) -> None:
    parameters = training_state.served_parameters(self._state)
    self.link.publish_parameters(parameters, version=self.limiter.updates)

  def _take_metrics(self) -> None:
    for who, values in self.link.take_metrics():
      self._write(who, {k: v for k, v in values.items() if k != "who"})
      if who.startswith("evaluator"):
        self._take_evaluation(values)
      elif isinstance(values.get("return"), int | float):
        self._recent.append(values)

  def _take_evaluation(self, values: dict[str, Any]) -> None:
    version = values.get("version")
    # None: of a learner before this one.
    parameters = self.link.held_parameters(version) if isinstance(version, int) else None
    if not self._best.take(values, is_held=parameters is not None):
      return
    self._attempt(
      lambda: self._checkpoints.save(
        self._state, self._info() | {"best_version": version}, kind=BEST
      )
    )
    self._attempt(lambda: self._export("best", parameters, {"version": version}))
    self.save()  # a learner that goes on from an older state would take a worse one for the best

  def _export(self, name: str, parameters: Any, info: dict[str, Any]) -> None:
    export.export_policy(
      self._settings.run / "policy" / name,
      parameters,
      layout=self.layout,
      environment=self._settings.environment,
      settings=to_plain(self._config),
      info=self._info() | info,
    )

  def save(self) -> None:
    """Writes a checkpoint and exports the policy; a failure is reported, and training goes on."""
    self._periods.restart("save")
    self._problem = ""
    self._attempt(lambda: self._checkpoints.save(self._state, self._info()))
    self._attempt(lambda: self._export("newest", training_state.served_parameters(self._state), {}))
    self._attempt(self.replay.flush)

  def _attempt(self, write: Any) -> None:
    try:
      write()
    except (CheckpointError, OSError) as error:
      self._problem = str(error)
      _log.error("%s", error)

  def _info(self) -> dict[str, Any]:
    with self.link.taking, self.link.lock:  # the steps are those of what the replay holds
      steps, updates = self.limiter.steps, self.limiter.updates
      refill_until, unpaid = self.limiter.refill_until, self.limiter.unpaid
      inserted = self.replay.inserted
    return {
      "environment": self._settings.environment,
      "config": to_plain(self._config),
      "seed": self._settings.seed,
      "steps": steps,
      "updates": updates,
      "refill_until": refill_until,
      "unpaid_steps": unpaid,
      "replay_inserted": inserted,
      **self._best.record(),
      "seconds": round(self._seconds, 1),
      "init_from": self._init_from,
    }

  def _status(self) -> dict[str, Any]:
    with self.link.lock:
      steps, updates, ready = self.limiter.steps, self.limiter.updates, self.limiter.filled
    best = self._best.record()
    status: dict[str, Any] = {
      "steps": steps,
      "updates": updates,
      "filled": ready,
      "replay_steps": self.replay.steps,
      "replay_needed": self._config.min_replay_steps,
      "problem": self._problem,
      "evaluation": self._best.evaluated,
      "best": best["best_return"],
      "best_success": best["best_success"],
      "seconds": self._seconds,
    }
    for name in ("return", "success", "localisation_error"):
      status[name] = self._mean(name)
    return status | self._rates.measure(steps, updates)

  def _mean(self, name: str) -> float | None:
    """Mean of a figure over the last acting episodes."""
    seen = [e[name] for e in self._recent if isinstance(e.get(name), int | float)]
    return float(np.mean(seen)) if seen else None

  def _write_own(self, metrics: dict[str, Any]) -> None:
    """Writes the learner's row; its times are means over the updates since the last one."""
    updates = self.limiter.updates
    times = self._times.take(updates - self._timed_updates)
    self._timed_updates = updates
    self._write("learner", {k: float(v) for k, v in metrics.items()} | self._status() | times)

  def _write(self, source: str, values: dict[str, Any]) -> None:
    figures = self.link.figures() if source == "learner" else {}
    with self.link.lock:
      steps, updates = self.limiter.steps, self.limiter.updates
    at = values.get("at_steps")  # an evaluation belongs to the steps of its parameters
    values = {k: v for k, v in values.items() if k not in ("steps", "updates", "at_steps")}
    self._log.write(
      source, values | figures, steps=at if isinstance(at, int) else steps, updates=updates
    )

  def _finish(self, metrics: dict[str, Any]) -> None:
    self.link.stop_actors()
    deadline = time.monotonic() + 3.0
    while self.link.alive() and time.monotonic() < deadline:
      time.sleep(0.05)
    self._take_metrics()
    if metrics:
      self._write_own(metrics)
    self.save()
    self.link.close()
    sessions.close(self._session)
    self._checkpoints.close()
    self._log.close()
