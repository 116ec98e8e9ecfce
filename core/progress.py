"""Progress reports of long computations, and what shows them: a bar, or lines where it is piped."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from rich import progress as rich_progress
from rich.console import Console

_LINE_PERIOD = 10.0  # s between lines
_SILENCE = 60.0  # s without a report after which the last one is printed again
Progress = Callable[[float, str], None]  # fraction done in [0, 1], what is being done


def no_progress(fraction: float, text: str) -> None:
  """Ignores a report of progress."""


def part(progress: Progress, start: float, end: float) -> Progress:
  """Returns the progress of a part of a computation: its 0 to 1 is `start` to `end` of the whole.

  Fractions outside [0, 1] are clipped.
  """

  def report(fraction: float, text: str) -> None:
    progress(start + (end - start) * min(max(fraction, 0.0), 1.0), text)

  return report


@contextlib.contextmanager
def progress_bar(
  name: str, *, shown: bool = True, console: Console | None = None
) -> Iterator[Progress]:
  """Shows progress while the block runs; yields what moves it.

  A terminal gets a bar. A pipe or a file gets plain lines, at most one in ten seconds, and in a
  minute without a report the last one again.
  """
  if not shown:
    yield no_progress
    return
  console = console or Console(stderr=True)
  if not console.is_terminal:
    lines, ended = _Lines(name, console), threading.Event()
    watch = threading.Thread(target=lines.keep_telling, args=(ended,), daemon=True)
    watch.start()
    try:
      yield lines
    finally:
      ended.set()
      watch.join()
    return
  columns = (
    rich_progress.TextColumn(f"{name:<12}"),
    rich_progress.BarColumn(bar_width=30),
    rich_progress.TaskProgressColumn(),
    rich_progress.TimeElapsedColumn(),
    rich_progress.TimeRemainingColumn(elapsed_when_finished=True),
    rich_progress.TextColumn("{task.description}"),
  )
  with rich_progress.Progress(*columns, console=console) as bar:
    task = bar.add_task("", total=1.0)
    yield lambda fraction, text: bar.update(task, completed=fraction, description=text)


class _Lines:
  """Prints progress as lines: share done, time, time left."""

  def __init__(self, name: str, console: Console):
    self._name, self._console = name, console
    self._begin = self._printed = time.monotonic()
    self._told = False
    self._last = (0.0, "", self._begin)
    self._lock = threading.Lock()

  def __call__(self, fraction: float, text: str) -> None:
    with self._lock:
      self._last = (fraction, text, time.monotonic())
      ends = fraction >= 1.0 and self._told  # a short stage says nothing
      if time.monotonic() - self._printed >= _LINE_PERIOD or ends:
        self._print()

  def keep_telling(self, ended: threading.Event) -> None:
    """Prints the last report again after each silence, until the end."""
    while not ended.wait(_LINE_PERIOD):
      with self._lock:
        if self._last[1] and time.monotonic() - self._printed >= _SILENCE:
          self._print()

  def _print(self) -> None:
    fraction, text, reported = self._last
    self._printed, self._told = time.monotonic(), True
    took = self._printed - self._begin
    # A silence is a part of what was left at the last report, it does not make all else longer.
    rest = (reported - self._begin) / fraction - took if 0.01 < fraction < 1.0 else 0.0
    left = f", about {rest:.0f} s left" if rest > 0.0 else ""
    line = f"{self._name}: {fraction:.0%} after {took:.0f} s{left}: {text}"
    self._console.print(line, soft_wrap=True, highlight=False, markup=False)
