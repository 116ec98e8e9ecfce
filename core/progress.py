"""Progress reports of long computations, and the progress bar that shows them."""

import contextlib
from collections.abc import Callable, Iterator

from rich import progress as rich_progress
from rich.console import Console

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
  """Draws a progress bar in the terminal while the block runs; yields what moves it."""
  if not shown:
    yield no_progress
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
