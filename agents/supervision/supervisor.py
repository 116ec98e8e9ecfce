"""Keeps the processes of a run alive: restarts within a window, and an end in order.

A `Process` runs on this machine (`LocalProcess`), or where Ray places it (`cluster.py`).
"""

import dataclasses
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from nerf2real.agents.link.child_processes import last_lines, start_child
from nerf2real.agents.supervision.statuses import NOT_SAVED, REFUSED

_MAX_RESTARTS = 5  # of one process within the restart window
_OTHERS_END_TIMEOUT = 10.0  # s for actors to deliver what they have
_BEFORE_LEARNING = (-signal.SIGTERM, 128 + signal.SIGTERM)  # ended while it was starting
_UNFINISHED = ".orbax-checkpoint-tmp"  # in the name of what a save that was cut off leaves
_MEANINGS = {
  REFUSED: " (it cannot start with its arguments)",
  NOT_SAVED: " (what it learned last is not saved: make room where the run is, then --resume)",
  -signal.SIGKILL: " (killed)",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
  """A process of a run: what is started."""

  name: str
  """Name for people."""
  script: Path
  """Python script."""
  arguments: tuple[str, ...]
  """Its command line; where Ray places it, {files} stands for the folder of the files."""
  files: Mapping[str, str] = dataclasses.field(default_factory=dict)
  """Small files by name, such as a login, that are written where Ray places the process."""
  needs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  """Options of the Ray actor: num_cpus, num_gpus, resources."""


class Process(Protocol):
  """A process that was started, wherever it runs."""

  waiting: bool
  """Whether it waits for a free place."""

  def exit_status(self) -> int | None:
    """Returns the status that it ended with, -1 if its machine was lost; None while it runs."""

  def last_words(self) -> str:
    """Returns the end of its output."""

  def terminate(self, timeout: float) -> None:
    """Sends SIGTERM, and SIGKILL after `timeout` [s]; returns at once where that is possible."""

  def wait(self) -> int | None:
    """Waits after `terminate` and returns the exit status; None if it is unknown."""

  def release(self) -> None:
    """Frees its place."""


class LocalProcess:
  """A process on this machine, with its output appended to a log."""

  waiting = False

  def __init__(self, script: Path, arguments: Sequence[str], *, log: Path):
    """Starts it."""
    self._log = log
    self._process = start_child([sys.executable, str(script), *arguments], log=log)
    self._deadline = float("inf")

  def exit_status(self) -> int | None:
    return self._process.poll()

  def last_words(self) -> str:
    return last_lines(self._log)

  def terminate(self, timeout: float) -> None:
    self._deadline = time.monotonic() + timeout
    if self._process.poll() is None:
      self._process.terminate()

  def wait(self) -> int | None:
    try:
      return self._process.wait(max(0.1, self._deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
      self._process.kill()
      return self._process.wait()

  def release(self) -> None:
    pass


@dataclasses.dataclass
class _Kept:
  """A job with its present process."""

  job: Job
  process: Process | None = None
  started: list[float] = dataclasses.field(default_factory=list)
  over: bool = False

  def starts_within(self, window: float) -> int:
    now = time.monotonic()
    return sum(now - t < window for t in self.started)


class Supervisor:
  """Keeps a learner and the processes beside it alive, and ends them in order."""

  def __init__(
    self,
    start: Callable[[Job], Process],
    learner: Job,
    others: Sequence[Job],
    *,
    checkpoints: Path,
    resume: bool,
    restart_window: float,
    end_timeout: float,
  ):
    """Starts nothing yet.

    Args:
      start: starts a job's process.
      learner: the learner, without --resume.
      others: actors and the evaluator.
      checkpoints: folder of the learner's checkpoints; a learner that died goes on from there.
      resume: whether the learner's first start resumes, too.
      restart_window: more than five restarts of a process within this time end the run [s].
      end_timeout: time for the learner's checkpoint at the end [s].
    """
    self._start, self._learner_job, self._checkpoints = start, learner, checkpoints
    self._window, self._end_timeout = restart_window, end_timeout
    self._learner = _Kept(_resumed(learner) if resume else learner)
    self._others = [_Kept(job) for job in others]
    self.restarts = 0
    self.refused = False  # the learner's first start was refused: nothing was learned

  @property
  def waiting(self) -> list[str]:
    """Names of the processes that wait for a free place."""
    return [k.job.name for k in self._all if k.process is not None and k.process.waiting]

  @property
  def _all(self) -> list[_Kept]:
    return [self._learner, *self._others]

  def start(self) -> None:
    """Starts all processes, the learner first."""
    for kept in self._all:
      self._begin(kept)

  def _begin(self, kept: _Kept) -> None:
    kept.started.append(time.monotonic())
    kept.process = self._start(kept.job)

  def watch(self) -> str | None:
    """Replaces what died; returns why the run ends ("" for its regular end), or None."""
    for kept in self._all:
      if kept.over or kept.process is None:
        continue
      status = kept.process.exit_status()
      if status is None:
        continue
      if status == 0:  # an actor ends when the learner is over
        kept.over = True
        if kept is self._learner:
          return ""
        continue
      hopeless = status in (REFUSED, NOT_SAVED)
      if hopeless or kept.starts_within(self._window) > _MAX_RESTARTS:
        kept.over = True
        first = kept is self._learner and len(kept.started) == 1
        self.refused = first and status == REFUSED
        return _death(kept, status)
      self.restarts += 1
      if kept is self._learner:
        saved = has_saved(self._checkpoints)
        kept.job = _resumed(self._learner_job) if saved else self._learner_job
      kept.process.release()
      self._begin(kept)
    return None

  def end(self) -> str:
    """Ends the actors, which deliver what they have, then the learner, which saves.

    Returns:
      How the learner failed to end in order; empty if it did not fail, or was over before.
    """
    self._terminate(self._others, _OTHERS_END_TIMEOUT)
    statuses = self._terminate([self._learner], self._end_timeout)
    orderly = (0, *_BEFORE_LEARNING)
    failed = [_death(self._learner, status) for status in statuses if status not in orderly]
    for kept in self._all:
      if kept.process is not None:
        kept.process.release()
    return "".join(failed)

  def _terminate(self, group: Sequence[_Kept], timeout: float) -> list[int | None]:
    running = [k.process for k in group if k.process is not None and not k.over]
    for process in running:
      process.terminate(timeout)
    return [process.wait() for process in running]


def has_saved(checkpoints: Path) -> bool:
  """Returns whether a learner left a whole checkpoint in its folder to go on from."""
  return any(_UNFINISHED not in path.name for path in checkpoints.glob("newest-*"))


def _resumed(learner: Job) -> Job:
  return dataclasses.replace(learner, arguments=(*learner.arguments, "--resume"))


def _death(kept: _Kept, status: int | None) -> str:
  """Returns how a process ended and its last words."""
  assert kept.process is not None
  who = kept.job.name[0].upper() + kept.job.name[1:]
  meaning = _MEANINGS.get(status, "") if status is not None else ""
  words = kept.process.last_words()
  reasons = re.findall("^error: (.*)$", words, re.MULTILINE)
  if status == REFUSED and reasons:  # what libraries logged while they loaded explains nothing
    return f"{who} ended with status {status}{meaning}: {reasons[-1]}"
  return f"{who} ended with status {status}{meaning}" + (f":\n{words}" if words else ".")
