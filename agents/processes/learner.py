"""The learner's process: replay, updates, parameters for the actors, checkpoints, logs.

Everything that waits for the accelerator happens in the thread that calls `Learner.run`; the link's
threads only fill the replay and answer questions.
"""

import collections
import dataclasses
import logging
import threading
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from nerf2real.agents.dmpo import config as configs
from nerf2real.agents.dmpo import export, learning
from nerf2real.agents.dmpo.replay import Replay, check_trajectory, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.link import sessions
from nerf2real.agents.link.limiter import LimiterSettings, RateLimiter
from nerf2real.agents.link.server import LearnerLink
from nerf2real.agents.processes.checkpoints import BEST, CheckpointError, Checkpoints
from nerf2real.agents.processes.environments import make_environment
from nerf2real.agents.processes.logs import MetricsLog
from nerf2real.core.serialization import to_plain

_log = logging.getLogger(__name__)
_RECENT_EPISODES = 20  # over which returns are averaged in the status
_STATUS_PERIOD = 0.5  # s
_ROUTER_TIMEOUT = 60.0  # s to wait for a router that is to be joined


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSettings:
  """Settings of a run, besides those of the agent."""

  environment: str
  """The environment's name; see `environments.py`."""
  run: Path
  """The run's folder."""
  seed: int = 0
  """Seed of parameters, sampling and, with an actor's number, of its episodes."""
  max_env_steps: int | None = None
  """Environment steps of the run; None: until it is stopped."""
  checkpoint_period: float = 300.0
  """Time between checkpoints [s]."""
  log_period: float = 10.0
  """Time between the learner's rows in the log [s]."""
  replay_on_disk: bool = False
  """Keep the replay in files of the run's folder, so that it survives the learner; otherwise it
  fills again after a restart."""
  evaluation_period: int = 10_000
  """Environment steps between evaluations [steps]."""
  evaluation_episodes: int = 5
  """Episodes of an evaluation."""


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
    """
    self._settings, self._config = settings, config
    self._stop = threading.Event()
    settings.run.mkdir(parents=True, exist_ok=True)
    environment = make_environment(settings.environment, seed=0, history=config.history)
    self.layout = Layout.of(environment)
    environment.close()
    self._learning = learning.make_learning(config, self.layout)
    self._state = jax.jit(self._learning.init)(jax.random.PRNGKey(settings.seed))
    self._checkpoints = Checkpoints(settings.run / "checkpoints")
    self._best = -np.inf
    steps = saved = 0
    if resume:
      self._state, info = self._checkpoints.restore(self._state)
      steps, saved = info["steps"], info["replay_inserted"]
      self._best = info["best_return"] if info["best_return"] is not None else -np.inf
    self.replay = self._open_replay(resume)
    if resume and self.replay.on_disk:
      steps += self.replay.steps_after(saved)  # what came after the checkpoint is not lost
    limiter = RateLimiter(
      LimiterSettings(
        steps_per_update=config.steps_per_update,
        min_replay_steps=config.min_replay_steps,
        trajectory_steps=config.trajectory_length - 1,
        max_steps=settings.max_env_steps,
      ),
      steps=steps,
      updates=int(self._state.steps),
    )
    if self.replay.steps >= config.min_replay_steps:
      limiter.already_filled()
    self._log = MetricsLog(settings.run)
    self._random = np.random.default_rng((settings.seed, int(self._state.steps)))
    self._recent: collections.deque[dict[str, Any]] = collections.deque(maxlen=_RECENT_EPISODES)
    self._rates = _Rates(limiter.steps, limiter.updates)
    self._last_save = time.monotonic()
    self._evaluated: float | None = None
    self._problem = ""
    if join:
      self._session = sessions.connect(endpoint, link, timeout=_ROUTER_TIMEOUT)
    else:
      self._session = sessions.listen(endpoint, link)
    self.link = LearnerLink(
      self._session,
      link,
      limiter=limiter,
      insert=self._insert,
      known=self.replay.origins(),
      description={
        "environment": settings.environment,
        "config": to_plain(config),
        "layout": to_plain(self.layout),
        "seed": settings.seed,
        "evaluation_period": settings.evaluation_period,
        "evaluation_episodes": settings.evaluation_episodes,
        "max_env_steps": settings.max_env_steps,
      },
    )
    self._publish()
    if not resume:  # so that a learner that dies early has something to go on from
      self.save()

  def _open_replay(self, resume: bool) -> Replay:
    lstm = self._state.policy["lstm"]["b"].shape[0] // 4 if "lstm" in self._state.policy else 0
    self._fields = trajectory_fields(self.layout, lstm_size=lstm)
    folder = self._settings.run / "replay"
    on_disk = self._settings.replay_on_disk or (resume and folder.exists())
    replay = Replay(
      self._fields,
      length=self._config.trajectory_length,
      capacity_steps=self._config.replay_steps,
      folder=folder if on_disk else None,
    )
    if replay.size and not resume:
      raise ValueError(f"{folder} holds the replay of another run: resume it, or remove it.")
    return replay

  def _insert(self, trajectory: Any, actor: int, number: int) -> int:
    steps = check_trajectory(trajectory, self._fields, length=self._config.trajectory_length)
    self.replay.insert(trajectory, actor=actor, number=number)
    return steps - 1

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
    """Learns until the run is over, then saves and closes."""
    metrics: dict[str, Any] = {}
    last_log = last_status = 0.0
    try:
      while not self._stop.is_set():
        with self.link.lock:
          due, finished = self.limiter.update_due, self.limiter.finished
        if finished:
          break
        if due:
          metrics = self._update(metrics)
        else:
          self._stop.wait(0.002)
        now = time.monotonic()
        if now - last_status > _STATUS_PERIOD:
          last_status = now
          self._take_metrics()
          self.link.set_status(self._status())
        if now - last_log > self._settings.log_period and metrics:
          last_log = now
          self._write("learner", {k: float(v) for k, v in metrics.items()} | self._status())
        if now - self._last_save > self._settings.checkpoint_period:
          self.save()
    finally:
      self._finish(metrics)

  def _update(self, previous: dict[str, Any]) -> dict[str, Any]:
    if previous:  # at most one update waits behind the one that the device works on
      jax.block_until_ready(previous["loss"])
    batch = self.replay.sample(self._random, self._config.batch_size)
    self._state, metrics = self._learning.update(self._state, batch)
    with self.link.lock:
      self.limiter.updated()
      updates = self.limiter.updates
    if updates % self._config.target_actor_period == 0:
      self._publish()
    return metrics

  def _publish(self) -> None:
    parameters = learning.served_parameters(self._state)
    self.link.publish_parameters(parameters, version=self.limiter.updates)

  def _take_metrics(self) -> None:
    while not self.link.metrics.empty():
      who, values = self.link.metrics.get()
      self._write(who, {k: v for k, v in values.items() if k != "who"})
      if who.startswith("evaluator"):
        self._take_evaluation(values)
      elif isinstance(values.get("return"), int | float):
        self._recent.append(values)

  def _take_evaluation(self, values: dict[str, Any]) -> None:
    result, version = values.get("return"), values.get("version")
    if not isinstance(result, int | float) or not isinstance(version, int):
      return
    self._evaluated = float(result)
    if result <= self._best:
      return
    self._best = float(result)
    self._attempt(
      lambda: self._checkpoints.save(
        self._state, self._info() | {"best_version": version}, kind=BEST
      )
    )
    parameters = self.link.held_parameters(version)
    if parameters is not None:
      self._attempt(lambda: self._export("best", parameters, {"version": version}))

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
    self._last_save = time.monotonic()
    self._problem = ""
    self._attempt(lambda: self._checkpoints.save(self._state, self._info()))
    self._attempt(lambda: self._export("newest", learning.served_parameters(self._state), {}))
    self._attempt(self.replay.flush)

  def _attempt(self, write: Any) -> None:
    try:
      write()
    except (CheckpointError, OSError) as error:
      self._problem = str(error)
      _log.error("%s", error)

  def _info(self) -> dict[str, Any]:
    with self.link.lock:
      steps, updates = self.limiter.steps, self.limiter.updates
    return {
      "environment": self._settings.environment,
      "config": to_plain(self._config),
      "layout": to_plain(self.layout),
      "seed": self._settings.seed,
      "steps": steps,
      "updates": updates,
      "replay_inserted": self.replay.inserted,
      "best_return": self._best if np.isfinite(self._best) else None,
    }

  def _status(self) -> dict[str, Any]:
    with self.link.lock:
      steps, updates, ready = self.limiter.steps, self.limiter.updates, self.limiter.filled
    status: dict[str, Any] = {
      "steps": steps,
      "updates": updates,
      "filled": ready,
      "replay_steps": self.replay.steps,
      "problem": self._problem,
      "evaluation": self._evaluated,
      "best": self._best if np.isfinite(self._best) else None,
    }
    for name in ("return", "success", "localisation_error"):
      seen = [e[name] for e in self._recent if isinstance(e.get(name), int | float)]
      status[name] = float(np.mean(seen)) if seen else None
    return status | self._rates.measure(steps, updates)

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
      self._write("learner", {k: float(v) for k, v in metrics.items()} | self._status())
    self.save()
    self.link.close()
    sessions.close(self._session)
    self._checkpoints.close()
    self._log.close()


class _Rates:
  """Steps and updates a second over the last half minute."""

  def __init__(self, steps: int, updates: int):
    self._points = collections.deque([(time.monotonic(), steps, updates)], maxlen=60)

  def measure(self, steps: int, updates: int) -> dict[str, float]:
    now = time.monotonic()
    self._points.append((now, steps, updates))
    begin, first_steps, first_updates = self._points[0]
    span = max(now - begin, 1e-3)
    return {
      "steps_per_second": (steps - first_steps) / span,
      "updates_per_second": (updates - first_updates) / span,
    }
