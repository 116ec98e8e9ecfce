"""Where a run's figures go: one JSONL file and TensorBoard, side by side."""

import json
import logging
import math
import numbers
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.summary import scalar

_log = logging.getLogger(__name__)


class MetricsLog:
  """Appends figures with their source, environment steps and updates."""

  def __init__(self, folder: Path, *, tensorboard: bool = True):
    """Opens `metrics.jsonl` in folder for appending, and a TensorBoard event file beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    self._file = (folder / "metrics.jsonl").open("a", buffering=1)
    self._events = _EventFile(folder / "tensorboard") if tensorboard else None
    self.failures = 0

  def write(self, source: str, values: Mapping[str, Any], *, steps: int, updates: int) -> None:
    """Writes figures; a full disk is counted and reported, and stops nothing.

    Args:
      source: who measured: "learner", "evaluator" or an actor's name.
      values: named numbers, or strings (JSONL only).
      steps: environment steps of the run.
      updates: updates of the run.
    """
    plain = {name: _plain(value) for name, value in values.items()}
    row = {"time": round(time.time(), 3), "source": source, "steps": steps, "updates": updates}
    try:
      self._file.write(json.dumps(row | plain) + "\n")
      if self._events is not None:
        group = source.partition("-")[0]  # "evaluator-0-1f2e3d4c" is another run's name tomorrow
        numeric = {
          f"{group}/{name}": float(value)
          for name, value in plain.items()
          if isinstance(value, numbers.Real)
        }
        self._events.write(numeric, step=steps)
    except OSError as error:
      self.failures += 1
      if self.failures == 1:
        _log.error("Metrics cannot be written (%s); training goes on.", error)

  def close(self) -> None:
    """Writes what is left."""
    try:
      self._file.close()
      if self._events is not None:
        self._events.close()
    except OSError as error:
      _log.error("Metrics cannot be written (%s).", error)


class _EventFile:
  """TensorBoard's event files, written in the caller's thread.

  The thread of tensorboardX's SummaryWriter dies when the disk is full; then its queue fills, and
  whoever writes waits for ever.
  """

  def __init__(self, folder: Path):
    folder.mkdir(parents=True, exist_ok=True)
    self._folder = folder
    self._writer: EventsWriter | None = None

  def write(self, values: Mapping[str, float], *, step: int) -> None:
    """Appends scalars; after an OSError, which is raised, the next call begins another file."""
    try:
      if self._writer is None:
        self._writer = EventsWriter(str(self._folder / "events"))
      for name, value in values.items():
        event = Event(wall_time=time.time(), step=step, summary=scalar(name, value))
        self._writer.write_event(event)
      self._writer.flush()
    except OSError:  # a record that was cut off would hide all that follow it in its file
      self._writer = None
      raise

  def close(self) -> None:
    """Closes the file."""
    if self._writer is not None:
      self._writer.close()


def _plain(value: Any) -> Any:
  """A number that JSON can hold; what is not finite becomes null."""
  if isinstance(value, str | bool) or value is None:
    return value
  if isinstance(value, int):
    return value
  number = float(value)
  return number if math.isfinite(number) else None
