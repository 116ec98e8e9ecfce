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
from nerf2real.agents.dmpo import learning, scaling, training_state
from nerf2real.agents.dmpo.policy import acting, export
from nerf2real.agents.dmpo.replay import Replay, check_trajectory, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.link import sessions
from nerf2real.agents.link.limiter import LimiterSettings, RateLimiter
from nerf2real.agents.link.server import LearnerLink
from nerf2real.agents.processes.checkpoints import BEST, CheckpointError, Checkpoints
from nerf2real.agents.processes.environments import evaluation_name, make_environment
from nerf2real.agents.processes.logs import MetricsLog
from nerf2real.agents.processes.timings import StageTimes
from nerf2real.core.serialization import to_plain

_log = logging.getLogger(__name__)
_RECENT_EPISODES = 20  # over which returns are averaged in the status
_STATUS_PERIOD = 0.5  # s
_ROUTER_TIMEOUT = 60.0  # s to wait for a router that is to be joined
_SCALING_TRAJECTORIES = 1024  # that the scaling of observations is measured on


class LearnerError(RuntimeError):
  """The run cannot go on; the message is one line for the user."""


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
  minutes: float | None = None
  """Time of the run [min], over all its parts where it is resumed; None: until it is stopped."""
  init_from: Path | None = None
  """Folder of an exported policy to begin with, optimisers and critic being fresh; None: random."""
  evaluation_period: int = 10_000
  """Environment steps between evaluations [steps]."""
  evaluation_episodes: int | None = None
  """Episodes of an evaluation; None: half of its protocol's trials, or 5 without a protocol."""
  evaluation_env: str | None = None
  """The environment of the evaluations; None: `environments.evaluation_name` says."""


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
    first_action = _first_action(environment, config, settings.environment)
    environment.close()
    self._learning = learning.make_learning(config, self.layout, first_action=first_action)
    self._state = jax.jit(self._learning.init)(jax.random.PRNGKey(settings.seed))
    self._checkpoints = Checkpoints(settings.run / "checkpoints")
    self._best = -np.inf  # return
    self._best_success: float | None = None
    self._begin, self._seconds_before = time.monotonic(), 0.0
    self._init_from = "" if settings.init_from is None else str(settings.init_from)
    info: dict[str, Any] = {}
    if resume:
      self._state, info = self._checkpoints.restore(self._state)
      self._best = info["best_return"] if info["best_return"] is not None else -np.inf
      self._best_success = info.get("best_success")
      self._seconds_before = info.get("seconds", 0.0)
      self._init_from = info.get("init_from", "")
    elif settings.init_from is not None:
      self._state = _begin_with(settings.init_from, self._state, self.layout)
    # Remembered: reading it from the state would wait for the update that the device works on.
    self._scaled = scaling.is_measured(self._state.scaling)
    self.replay = self._open_replay(resume)
    limiter = self._make_limiter(info)
    self._log = MetricsLog(settings.run)
    self._random = np.random.default_rng((settings.seed, int(self._state.steps)))
    self._recent: collections.deque[dict[str, Any]] = collections.deque(maxlen=_RECENT_EPISODES)
    self._rates = _Rates(limiter.steps, limiter.updates)
    self._last_save = time.monotonic()
    self._evaluated: float | None = None
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
      insert=self._insert,
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
        "max_env_steps": settings.max_env_steps,
      },
    )
    self._publish()
    if not resume:  # so that a learner that dies early has something to go on from
      self.save()

  def _make_limiter(self, info: dict[str, Any]) -> RateLimiter:
    """The run's counters: new ones, or those of the checkpoint that `info` belongs to."""
    config, replay = self._config, self.replay
    steps = info.get("steps", 0)
    if info and replay.on_disk:
      steps += replay.steps_after(info["replay_inserted"])  # what came later is not lost
    settings = LimiterSettings(
      steps_per_update=config.steps_per_update,
      min_replay_steps=config.min_replay_steps,
      trajectory_steps=config.trajectory_length - 1,
      max_steps=self._settings.max_env_steps,
    )
    if not info:
      end = self._settings.max_env_steps
      if end is not None and end <= config.min_replay_steps:
        _log.warning(
          "No update will be made: %d steps fill the replay, the run has %d.",
          config.min_replay_steps,
          end,
        )
      return RateLimiter(settings)
    limiter = RateLimiter(
      settings,
      steps=steps,
      updates=int(self._state.steps),
      refill_until=info.get("refill_until", 0),
      unpaid=info.get("unpaid_steps", 0),
    )
    if replay.steps < config.min_replay_steps:
      limiter.refill(held=replay.steps)
    return limiter

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
    """Learns until the run is over, then saves and closes.

    Raises:
      LearnerError: trajectories can no longer be taken in, such as on a full disk.
    """
    metrics: dict[str, Any] = {}
    last_log = last_status = 0.0
    try:
      while not self._stop.is_set():
        with self.link.lock:
          due, finished = self.limiter.update_due, self.limiter.finished
        if finished or self._time_is_up():
          break
        if self.link.failure:
          raise LearnerError(f"No trajectory can be taken in any more: {self.link.failure}")
        if due:
          metrics = self._update(metrics)
        else:
          with self._times.stage("waiting"):
            self._stop.wait(0.002)
        now = time.monotonic()
        if now - last_status > _STATUS_PERIOD:
          last_status = now
          self._take_metrics()
          self.link.set_status(self._status())
        if now - last_log > self._settings.log_period and metrics:
          last_log = now
          self._write_own(metrics)
        if now - self._last_save > self._settings.checkpoint_period:
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

  def _update(self, previous: dict[str, Any]) -> dict[str, Any]:
    if not self._scaled:
      self._measure_scaling()
    with self._times.stage("sampling"):
      batch = self.replay.sample(self._random, self._config.batch_size)
    with self._times.stage("update"):
      if previous:  # at most one update waits behind the one that the device works on
        jax.block_until_ready(previous["loss"])
      self._state, metrics = self._learning.update(self._state, batch)
    with self.link.lock:
      self.limiter.updated()
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
    success = values.get("success")
    if not isinstance(success, int | float):
      better = result > self._best
      success = None
    elif values.get("confirmation"):
      best = -1.0 if self._best_success is None else self._best_success
      better = (success, result) > (best, self._best)
    else:  # the figure that made the policy look good is not the one to remember
      better = False
    if not values.get("confirmation"):
      self._evaluated = float(result)
    if not better:
      return
    self._best, self._best_success = float(result), success
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
    self._attempt(lambda: self._export("newest", training_state.served_parameters(self._state), {}))
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
      refill_until, unpaid = self.limiter.refill_until, self.limiter.unpaid
    return {
      "environment": self._settings.environment,
      "config": to_plain(self._config),
      "layout": to_plain(self.layout),
      "seed": self._settings.seed,
      "steps": steps,
      "updates": updates,
      "refill_until": refill_until,
      "unpaid_steps": unpaid,
      "replay_inserted": self.replay.inserted,
      "best_return": self._best if np.isfinite(self._best) else None,
      "best_success": self._best_success,
      "seconds": round(self._seconds, 1),
      "init_from": self._init_from,
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
      "best_success": self._best_success,
      "seconds": self._seconds,
    }
    for name in ("return", "success", "localisation_error"):
      seen = [e[name] for e in self._recent if isinstance(e.get(name), int | float)]
      status[name] = float(np.mean(seen)) if seen else None
    return status | self._rates.measure(steps, updates)

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


def _first_action(environment: Any, config: configs.DmpoConfig, name: str) -> np.ndarray | None:
  """The action that the policy's mean is about at the start [A]; None for zero."""
  if config.first_action == configs.ZERO:
    return None
  action = getattr(acting.task_of(environment), "standing_action", None)
  if action is None:
    raise ValueError(
      f"{name} has no standing action, as first_action={configs.STANDING!r} wants: use another "
      'preset, or --set first_action="zero".'
    )
  return np.asarray(action, np.float32)


def _begin_with(
  folder: Path, state: training_state.TrainingState, layout: Layout
) -> training_state.TrainingState:
  """A fresh state with the policy of a folder; raises ValueError if it does not fit."""
  exported, arrays = export.load_policy(folder), export.load_arrays(folder)
  sizes = ("image_shape", "state_names", "state_sizes", "action_size")
  for name in sizes:
    found, expected = getattr(exported.layout, name), getattr(layout, name)
    if found != expected:
      raise ValueError(
        f"{folder} cannot be begun with: its {name} is {found}, this environment's {expected}."
      )
  return training_state.with_policy(state, arrays)


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
