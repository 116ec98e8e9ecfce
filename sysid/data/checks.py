"""What a log of another format must be to be usable, and one that stands alone; of MCAP see
`core.robot_logs.reading`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerf2real.core.files import hash_path
from nerf2real.core.robot_logs.reading import Log, check_extent
from nerf2real.core.robot_logs.streaming import LogError
from nerf2real.sysid.model.measured import block_starts

_FEWEST_BLOCKS = 3
"""Blocks of a log from which on parts of it can be left out and predicted by the others."""


def checked(log: Log) -> Log:
  """Returns a log whose times increase, and that is long, fast and finite enough.

  Raises:
    LogError: it is not.
  """
  for what, series in (("commands", log.commands), ("states", log.states)):
    steps = np.diff(series.stamp)
    if np.any(steps < 0):
      at = int(np.argmax(steps < 0)) + 1
      raise LogError(
        f"{log.name}: time runs backwards by {-steps[at - 1]:.6g} s at reading {at} of the {what}, "
        "expected increasing times."
      )
    for field in ("position", "velocity", "effort"):
      values = getattr(series, field)
      told = slice(None) if values is None else ~np.isnan(values).all(axis=0)
      if values is not None and not np.isfinite(values[:, told]).all():
        raise LogError(f"{log.name}: {what} hold infinite {field}s, expected finite numbers.")
  check_extent(log)
  return log


def check_distinct(paths: Sequence[Path]) -> None:
  """Raises a LogError where two files have the same content: a log that is given twice counts
  twice, and one that was fitted says nothing as a held or reference log."""
  seen: dict[str, Path] = {}
  for path in map(Path, paths):
    if not path.is_file():  # what is missing is said where it is read
      continue
    first = seen.setdefault(content := hash_path(path), path)
    if first is not path:
      same = f"{path} is given twice" if path == first else f"{path} and {first} are the same log"
      raise LogError(
        f"{same} (SHA-256 {content[:8]}), expected logs of different recordings among those to "
        "identify from, --held and --reference: give each once."
      )


def check_length(logs: Sequence[Log], block_s: float) -> None:
  """Raises a LogError where a single log is too short to predict a part of it by the others.

  Args:
    logs: that are fitted together; of several each is predicted by the others.
    block_s: s of a block of the likelihood.
  """
  if len(logs) != 1 or len(block_starts(logs[0].states.stamp, block_s)) >= _FEWEST_BLOCKS:
    return
  raise LogError(
    f"{logs[0].name} alone is too short: found {np.ptp(logs[0].states.stamp):.3g} s of readings, "
    f"expected at least {_FEWEST_BLOCKS * block_s:g} s: record a longer log, or give several."
  )
