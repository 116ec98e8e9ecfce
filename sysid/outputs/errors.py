"""Errors of the extended model before and after, and the floor of the readings."""

from collections.abc import Sequence

import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.model.simulation import Member
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.settings import Settings


def errors(
  found: Identified, logs: Sequence[Log], near: Sequence[Member], settings: Settings
) -> dict[str, float]:
  """Returns RMSE before and after, over the joints that the logs command."""
  window = settings.window_s
  before = evaluation.error(found.model, logs, window_s=window)
  return {"before": before} | evaluation.errors(found.model, logs, near, window_s=window)


def floor(logs: Sequence[Log], joints: Sequence[str]) -> float:
  """Returns what no smooth model can explain, rad (or m) rms over joints.

  Readings scatter about any smooth motion by rounding, noise and stamps that are off while the
  joint moves: that is what their differences of fourth order keep (70 times its variance). The
  largest hundredth, stale readings, is left out.
  """
  squares = []
  for log in logs:
    position = log.states.position
    assert position is not None
    columns = [log.states.column(joint) for joint in joints]
    fourth = np.sort(np.square(np.diff(position[:, columns], n=4, axis=0)), axis=0)
    squares.append(fourth[: max(1, int(0.99 * len(fourth)))].mean(axis=0) / 70.0)
  return float(np.sqrt(np.mean(squares)))
