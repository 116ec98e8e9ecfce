"""Clocks of `real`: the machine's, and one of stepped time that jumps from event to event.

`RealClock` is for hardware. `SteppedClock` makes a rehearsal with a virtual robot faster than real
time and repeatable: nothing waits, periodic work runs in the caller's thread when its time comes,
and the virtual robot answers before a write returns.
"""

import logging
import os
import select
import sys
import threading
import time
from collections.abc import Callable
from typing import Protocol

_SWITCH_INTERVAL = 0.0001  # s that a thread may keep others from running; Python's own is 5 ms
_WATCHING, _ACTING = 20, 10  # of SCHED_FIFO, 1 to 99; chosen: above ordinary programs
_log = logging.getLogger(__name__)


def prefer_this_thread(*, acting: bool = False) -> bool:
  """Gives this thread a real-time priority on Linux, as motion control does.

  Threads and processes that it starts are ordinary ones.

  Args:
    acting: Whether it computes actions; threads that watch the robot come before it.

  Returns:
    Whether that is so. It needs root, CAP_SYS_NICE or an `rtprio` limit (limits.conf).
  """
  try:
    priority = os.sched_param(_ACTING if acting else _WATCHING)
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, priority)
  except OSError:
    _log.info("no real-time priority for %s: readings may be late", threading.current_thread().name)
    return False
  return True


class Clock(Protocol):
  """What the loop needs of time; all times are seconds since some fixed moment."""

  def now(self) -> float:
    """Returns the time [s]."""

  def wall(self, time: float) -> float:
    """Returns the time since 1970 [s] at a time of this clock."""

  def sleep_until(self, time: float) -> None:
    """Returns at a time, or at once if it has passed."""

  def wait_readable(self, descriptor: int, seconds: float) -> None:
    """Returns when a file descriptor can be read, or after some seconds."""

  def settle(self) -> None:
    """Is called when bytes were written, so that a rehearsal can answer them."""

  def every(self, period: float, work: Callable[[], None], *, name: str) -> "Job":
    """Runs some work periodically until the job is stopped."""


class Job(Protocol):
  """Periodic work."""

  missed: int  # periods in which the work was not started, because it was still running

  def stop(self) -> None:
    """Ends it; returns when it no longer runs."""


class RealClock:
  """The machine's clock."""

  def __init__(self) -> None:
    self._offset = time.time() - time.monotonic()

  def now(self) -> float:
    return time.monotonic()

  def wall(self, time: float) -> float:
    return time + self._offset

  def sleep_until(self, time_: float) -> None:
    left = time_ - time.monotonic()
    if left > 0:
      time.sleep(left)

  def wait_readable(self, descriptor: int, seconds: float) -> None:
    if seconds > 0:
      select.select((descriptor,), (), (), seconds)

  def settle(self) -> None:
    pass

  def every(self, period: float, work: Callable[[], None], *, name: str) -> "Thread":
    return Thread(self, period, work, name=name)


class Thread:
  """Runs work in a thread at multiples of a period."""

  def __init__(self, clock: RealClock, period: float, work: Callable[[], None], *, name: str):
    self.missed = 0
    self._clock, self._period, self._work = clock, period, work
    self._stop = threading.Event()
    # With Python's 5 ms a computing thread would take the bus thread's whole period.
    sys.setswitchinterval(min(sys.getswitchinterval(), _SWITCH_INTERVAL))
    self._thread = threading.Thread(target=self._run, name=name, daemon=True)
    self._thread.start()

  def _run(self) -> None:
    prefer_this_thread()
    due = self._clock.now()
    while not self._stop.is_set():
      self._clock.sleep_until(due)
      self._work()
      due += self._period
      late = self._clock.now() - due
      if late > 0:
        skipped = int(late / self._period) + 1
        self.missed += skipped
        due += skipped * self._period

  def stop(self) -> None:
    self._stop.set()
    if threading.current_thread() is not self._thread:
      self._thread.join()


class SteppedClock:
  """A clock without waiting, for one thread."""

  def __init__(self) -> None:
    self._now = 0.0
    self._offset = time.time()
    self._jobs: list[SteppedJob] = []
    self.answer: Callable[[], None] = lambda: None  # lets the virtual robot answer what was written

  def now(self) -> float:
    return self._now

  def wall(self, time: float) -> float:
    return time + self._offset

  def advance(self, time: float) -> None:
    """Moves to a time without running periodic work."""
    self._now = max(self._now, time)

  def sleep_until(self, time: float) -> None:
    while self._jobs:
      job = min(self._jobs, key=lambda job: job.due)
      if job.due > time:
        break
      self.advance(job.due)
      job.run(self)
    self.advance(time)

  def wait_readable(self, descriptor: int, seconds: float) -> None:
    ready, _, _ = select.select((descriptor,), (), (), 0)
    if not ready:  # an answer would be there already: none will come
      self._now += max(seconds, 0.0)

  def settle(self) -> None:
    self.answer()

  def every(self, period: float, work: Callable[[], None], *, name: str) -> "SteppedJob":
    job = SteppedJob(self._jobs, self._now, period, work)
    self._jobs.append(job)
    return job


class SteppedJob:
  """Periodic work of a `SteppedClock`."""

  def __init__(self, jobs: list, start: float, period: float, work: Callable[[], None]):
    self.missed = 0
    self.due = start
    self._jobs, self._period, self._work = jobs, period, work

  def run(self, clock: SteppedClock) -> None:
    """Does the work that is due."""
    self._work()
    self.due += self._period
    late = clock.now() - self.due
    if late > 0:
      skipped = int(late / self._period) + 1
      self.missed += skipped
      self.due += skipped * self._period

  def stop(self) -> None:
    if self in self._jobs:
      self._jobs.remove(self)
