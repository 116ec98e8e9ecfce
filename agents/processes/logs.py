"""Where a run's figures go: one JSONL file and TensorBoard, side by side."""

import json
import logging
import math
import numbers
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)


class MetricsLog:
  """Appends figures with their source, environment steps and updates."""

  def __init__(self, folder: Path, *, tensorboard: bool = True):
    """Opens `metrics.jsonl` in folder for appending, and a TensorBoard event file beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    self._file = (folder / "metrics.jsonl").open("a", buffering=1)
    self._writer = None
    self.failures = 0
    if tensorboard:
      from tensorboardX import SummaryWriter

      self._writer = SummaryWriter(str(folder / "tensorboard"), write_to_disk=True)

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
      if self._writer is not None:
        group = "actor" if source.startswith("actor") else source
        for name, value in plain.items():
          if isinstance(value, numbers.Number):
            self._writer.add_scalar(f"{group}/{name}", value, steps)
    except OSError as error:
      self.failures += 1
      if self.failures == 1:
        _log.error("Metrics cannot be written (%s); training goes on.", error)

  def close(self) -> None:
    """Writes what is left."""
    try:
      self._file.close()
      if self._writer is not None:
        self._writer.close()
    except OSError as error:
      _log.error("Metrics cannot be written (%s).", error)


def _plain(value: Any) -> Any:
  """A number that JSON can hold; what is not finite becomes null."""
  if isinstance(value, str | bool) or value is None:
    return value
  if isinstance(value, int):
    return value
  number = float(value)
  return number if math.isfinite(number) else None
