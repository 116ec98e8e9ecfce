"""Histories of a policy's readings: the same buffers in simulation and on the robot."""

from collections.abc import Mapping

import numpy as np

from nerf2real.suite import specs


class Histories:
  """The last `specs.HISTORY` values of every reading, oldest first, float32."""

  def __init__(self) -> None:
    self._rows = {
      name: np.zeros((specs.HISTORY, size), np.float32)
      for name, (size, _) in specs.PROPRIOCEPTION.items()
    }

  def fill(self, values: Mapping[str, np.ndarray]) -> None:
    """Makes the past what is now."""
    for name, rows in self._rows.items():
      rows[:] = values[name]

  def push(self, values: Mapping[str, np.ndarray]) -> None:
    """Moves on by one control step."""
    for name, rows in self._rows.items():
      rows[:-1] = rows[1:]
      rows[-1] = values[name]

  def read(self, name: str) -> np.ndarray:
    """Returns a copy of a reading's history [H, size]."""
    return self._rows[name].copy()
