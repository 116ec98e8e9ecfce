"""The learner of a distillation: takes labelled episodes in, trains and serves the student.

What a run leaves in its folder: `data/` (episodes), `checkpoints/` (the learner's state),
`settings.json`, `policy/newest` (the exported student), `policy/kept_NNN` (where students are kept,
the first of every such period) and `metrics.jsonl`. Files are written whole; a killed run goes on
from its last state with all its episodes.
"""

import contextlib
import dataclasses
import logging
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from nerf2real.agents.distill import settings as stages
from nerf2real.agents.distill.dataset import Dataset
from nerf2real.agents.distill.learning.beginning import begin_with
from nerf2real.agents.distill.learning.checkpoint import (
  STATE,
  Counters,
  load_counters,
  load_state,
  save_state,
)
from nerf2real.agents.distill.learning.training import Trainer
from nerf2real.agents.distill.schedule import BORROWED, stage_at
from nerf2real.agents.distill.settings import SETTINGS, DistillSettings
from nerf2real.agents.distill.views import kept_views
from nerf2real.agents.dmpo import scaling
from nerf2real.agents.dmpo.policy.export import check_beginning, export_policy, load_arrays
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments.loading import in_scene, make_environment
from nerf2real.agents.link import sessions
from nerf2real.agents.link.limiter import LimiterSettings, RateLimiter
from nerf2real.agents.link.server import LearnerLink
from nerf2real.agents.processes.logs import MetricsLog
from nerf2real.agents.processes.timings import Periods, Rates, StageTimes
from nerf2real.core.serialization import to_plain, write_json

_log = logging.getLogger(__name__)
POLICY = Path("policy") / "newest"
VIEWS = "views.npz"
_WAIT = 0.5  # s between looks for the first frames
_SLACK = 10_000  # frames that collectors may be on the way with when the run has all
_VALIDATION_PERIOD = 120.0  # s, at least
_VALIDATION_REST = 10.0  # times as long as a validation took, at least, until the next


class _StopAskedError(Exception):
  """`stop` was called while views were rendered."""


class Learner:
  """Owns data set, student and link; `run` trains until its minutes are over."""

  def __init__(
    self,
    settings: DistillSettings,
    run: Path,
    *,
    endpoint: str,
    link: sessions.LinkSettings,
    seed: int | None,
    minutes: float,
    resume: bool,
  ):
    """Begins a run or continues one.

    Args:
      settings: of the distillation.
      run: the run's folder.
      endpoint: where to listen.
      link: the link's settings.
      seed: of first weights, augmentation and sampling; None: 0, or a continued run's own.
      minutes: training time over all parts of the run [min].
      resume: continues the run in the folder.

    Raises:
      ValueError: the folder holds a run already, or none to continue; the policy to begin with is
        of other observations or actions.
      LinkError: the endpoint is taken, or open to the network without users.
    """
    self._settings, self._run, self._minutes = settings, run, minutes
    if (run / STATE).exists() != resume:
      raise ValueError(
        f"{run} holds no run to continue: leave --resume out."
        if resume
        else f"{run} holds a run already: continue it with --resume, or take another folder."
      )
    counters = load_counters(run / STATE) if resume else Counters()
    seed = self._seed = counters.seed if seed is None else seed
    self._counters = dataclasses.replace(counters, seed=seed)
    environment = make_environment(settings.environment, seed=seed)
    self._layout = Layout.of(environment)
    environment.close()
    self._data = Dataset(
      run / "data",
      self._layout,
      capacity=settings.max_frames + _SLACK,
      holdout=settings.holdout,
    )
    self._times = StageTimes()
    self._trainer = Trainer(settings, self._layout, self._data, seed=seed, times=self._times)
    if resume:
      self._trainer.state, _ = load_state(run / STATE, like=self._trainer.state)
    borrowed = None
    if settings.init_from and self._counters.begun is None:  # it drives from the first frame on
      check_beginning(settings.init_from, self._layout)
      borrowed = load_arrays(settings.init_from)
      if not resume:
        self._trainer.state = begin_with(self._trainer.state, borrowed)
    write_json(run / SETTINGS, settings)
    save_state(run / STATE, self._trainer.state, self._counters)
    limiter = RateLimiter(
      LimiterSettings(
        steps_per_update=1.0,
        min_replay_steps=settings.max_frames,
        trajectory_steps=1,  # no `max_steps`: a run goes on when its last frame is there
      ),
      steps=self._data.frames,
    )
    self._log = MetricsLog(run, tensorboard=False)
    self._stop = threading.Event()
    self._periods = Periods()
    self._validation_period = _VALIDATION_PERIOD
    self._evaluation: dict[str, Any] = {}  # the last one
    # Whether encoder and policy belong together now; in a saved state they may not.
    self._is_fit = bool(settings.init_from) and not self._counters.updates
    self._compiled: set[str] = set()  # kinds of stages whose update was called
    self._recent: list[dict[str, jax.Array]] = []
    self._rates = Rates(self._data.frames, self._counters.updates)
    self._session = sessions.listen(endpoint, link)
    self._link = LearnerLink(
      self._session,
      link,
      limiter=limiter,
      insert=self._data.insert,
      known=self._data.origins,
      description={
        "settings": to_plain(settings),
        "layout": to_plain(self._layout),
        "kind": stages.KIND,
        "seed": seed,
        "begin_steps": self._data.frames,
        "begun": self._counters.begun,
      },
    )
    self._set_status()
    if borrowed is not None:
      self._link.publish_parameters(borrowed, version=self._version)
    elif (run / POLICY).exists():
      self._link.publish_parameters(load_arrays(run / POLICY), version=self._version)

  @property
  def _version(self) -> int:
    return BORROWED if self._counters.begun is None else BORROWED + self._counters.updates

  @property
  def _progress(self) -> float:
    return self._counters.elapsed / (60.0 * self._minutes)

  def stop(self) -> None:
    """Ends `run` with a saved state; safe in a signal handler."""
    self._stop.set()

  def run(self) -> None:
    """Trains until the minutes are over or `stop` is called.

    Raises:
      RuntimeError: episodes can no longer be taken in.
    """
    try:
      self._wait_for_first_frames()
      while not self._stop.is_set() and self._progress < 1.0:
        index, _ = stage_at(self._settings, self._progress)
        self._run_stage(index)
    finally:
      self._save()
      self._link.stop_actors()
      self._drain_metrics()
      self._log.close()

  def close(self) -> None:
    """Leaves the link."""
    self._link.close()
    sessions.close(self._session)

  def _wait_for_first_frames(self) -> None:
    while self._data.frames < self._settings.first_frames and not self._stop.is_set():
      self._check_link()
      self._drain_metrics()
      self._set_status()
      self._stop.wait(_WAIT)
    if self._settings.views and not self._stop.is_set():
      with contextlib.suppress(_StopAskedError):
        self._trainer.views = self._make_views()
    if self._stop.is_set() or scaling.is_measured(self._trainer.state.scales):
      return
    self._trainer.standardise()
    _log.info("Training begins with %d frames.", self._data.frames)

  def _make_views(self) -> dict[str, np.ndarray]:
    """Returns the run's pictures at drawn places, rendered once a run: minutes on a loaded core.

    Raises:
      _StopAskedError: `stop` was called; a run that is resumed renders them.
    """
    name, count = self._settings.environment, self._settings.views

    def report(done: float, text: str) -> None:
      if self._stop.is_set():
        raise _StopAskedError
      if self._periods.due("status", _WAIT):
        self._set_status(doing=f"{text}: {round(done * count):,} of {count:,}")

    return kept_views(
      self._run / VIEWS,
      [name, *(in_scene(name, scene) for scene in self._settings.view_scenes)],
      self._layout,
      self._run / "data",
      seed=self._seed,
      count=count,
      report=report,
    )

  # ---- stages ----

  def _run_stage(self, index: int) -> None:
    kind = self._settings.stages[index].kind
    _log.info("Stage %d: %s.", index, kind)
    begin = time.monotonic()
    self._recent.clear()
    done = 0
    self._trainer.begin_stage(kind)
    while not self._stop.is_set() and self._progress < 1.0:
      current, within = stage_at(self._settings, self._progress)
      if current != index:
        break
      metrics = self._trainer.update(within)
      now = time.monotonic()
      # An update that was compiled for minutes is no minute of training.
      counted = now - begin if kind in self._compiled else 0.0
      begin, self._compiled = now, self._compiled | {kind}
      self._counters = dataclasses.replace(
        self._counters,
        updates=self._counters.updates + 1,
        elapsed=self._counters.elapsed + counted,
      )
      self._recent.append(metrics)
      done += 1
      # They do not fit while the encoder learns, nor until the policy has learned its features.
      self._is_fit = kind == stages.END_TO_END or (
        kind in stages.OF_FEATURES and done >= self._settings.settling
      )
      if self._is_fit:
        self._begin_serving()
      self._housekeeping(kind)
    if kind in stages.OF_FEATURES and not self._stop.is_set():  # it learned what a short one can
      self._is_fit = True
      self._begin_serving()
    self._save()

  def _begin_serving(self) -> None:
    """Serves the run's first own student."""
    if self._counters.begun is None:
      self._counters = dataclasses.replace(self._counters, begun=self._data.frames)
      self._publish()

  # ---- periodical work ----

  def _housekeeping(self, kind: str) -> None:
    settings = self._settings
    if self._is_fit and self._periods.due("publish", settings.publish_period):
      self._publish()
    if self._periods.due("save", settings.save_period):
      with self._times.stage("saving"):
        self._save()
    if self._periods.due("log", settings.log_period):
      self._check_link()
      self._drain_metrics()
      values = {name: float(np.mean([m[name] for m in self._recent])) for name in self._recent[0]}
      figures = {"stage": kind, "minutes": self._counters.elapsed / 60, "progress": self._progress}
      self._write("learner", values | figures | self._times.take(len(self._recent)))
      self._set_status()
      self._recent.clear()
    if self._periods.due("validate", self._validation_period):
      begin = time.monotonic()
      with self._times.stage("validation"):
        found = self._trainer.validate()
      taken = time.monotonic() - begin
      self._validation_period = max(_VALIDATION_PERIOD, _VALIDATION_REST * taken)
      self._write("validation", found)

  def _check_link(self) -> None:
    if self._link.failure:
      raise RuntimeError(f"Episodes are no longer taken in: {self._link.failure}")

  def _write(self, source: str, values: Mapping[str, Any]) -> None:
    self._log.write(source, values, steps=self._data.frames, updates=self._counters.updates)
    if source in ("learner", "validation", "evaluator"):
      shown = {n: round(v, 4) if isinstance(v, float) else v for n, v in values.items()}
      _log.info("%d frames, %s: %s", self._data.frames, source, shown)

  def _drain_metrics(self) -> None:
    for who, values in self._link.take_metrics():
      if who.startswith("evaluator"):
        self._evaluation = values
      self._write(who.partition("-")[0], values)

  def _set_status(self, *, doing: str = "") -> None:
    """Offers the figures that `agents.supervision.status_view` shows, and what is being done."""
    frames, updates = self._data.frames, self._counters.updates
    status = {
      "steps": frames,
      "updates": updates,
      "filled": frames >= self._settings.first_frames,
      "doing": doing,
      "success": self._evaluation.get("success"),
      "localisation_error": self._evaluation.get("localisation_error"),
      "replay_steps": frames,
      "replay_needed": self._settings.first_frames,
    }
    self._link.set_status(status | self._rates.measure(frames, updates))

  def _publish(self) -> None:
    self._link.publish_parameters(self._trainer.served_parameters(), version=self._version)

  def _save(self) -> None:
    save_state(self._run / STATE, self._trainer.state, self._counters)
    if not self._is_fit:
      return
    self._publish()
    self._export(self._run / POLICY)
    if self._settings.keep_minutes > 0:
      period = int(self._counters.elapsed / 60 / self._settings.keep_minutes)
      kept = self._run / POLICY.parent / f"kept_{period:03d}"
      if not kept.exists():
        self._export(kept)

  def _export(self, folder: Path) -> None:
    export_policy(
      folder,
      self._trainer.served_parameters(),
      layout=self._layout,
      environment=self._settings.environment,
      settings=to_plain(self._settings.agent),
      info={
        "steps": self._data.frames,
        "updates": self._counters.updates,
        "teacher": self._settings.teacher,
      },
    )
