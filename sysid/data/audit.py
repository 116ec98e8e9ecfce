"""Looks at logs before anything is fitted: clocks, rate, gaps, repeats, resolution, saturation.

Shapes: N messages, J joints.
"""

from typing import Any

import numpy as np

from nerf2real.core.robot_logs.reading import JointSeries, Log
from nerf2real.sysid.model.measured import fresh, quantum
from nerf2real.sysid.model.motion import smooth_motion
from nerf2real.sysid.settings import SETTINGS

_GAP = 3.0  # median periods without a message that count as a gap
_DRIFT = 200e-6  # s/s between the stamps' clock and the recorder's that is worth a warning
_STALE = 0.02  # share of repeated readings that is worth a warning


def audit(log: Log) -> dict[str, Any]:
  """Returns figures of a log and warnings about it.

  The drift is the slope of recorder's time over header stamp, less one; relative to that of the
  commands for the states' clock.
  """
  states, commands = log.states, log.commands
  motion = smooth_motion(log)
  assert states.position is not None
  stale = [
    float(np.mean(~fresh(states.stamp, states.position[:, j], motion.velocity[:, j])))
    for j in range(len(states.joints))
  ]
  steps = [quantum(column) for column in states.position.T]
  result: dict[str, Any] = {
    "log": log.name,
    "duration_s": round(log.duration, 3),
    "joints": len(states.joints),
    "state_rate_hz": _rate(states),
    "command_rate_hz": _rate(commands),
    "state_gaps": _gaps(states),
    "command_gaps": _gaps(commands),
    "duplicate_stamps": int(np.sum(np.diff(states.stamp) == 0)),
    "stale_share": round(max(stale), 4),
    "position_step": min((step for step in steps if step > 0.0), default=0.0),  # still ones: 0
    "state_clock_drift": _drift(states) - _drift(commands),
    "recorder_drift": _drift(commands),
    "saturated_share": _saturated(states),
  }
  result["warnings"] = _warnings(log, result)
  return result


def _rate(series: JointSeries) -> float:
  steps = _steps(series)
  return round(1.0 / float(np.median(steps)), 3) if len(steps) else 0.0


def _gaps(series: JointSeries) -> int:
  steps = _steps(series)
  return int(np.sum(steps > _GAP * np.median(steps))) if len(steps) else 0


def _steps(series: JointSeries) -> np.ndarray:
  """Returns the times between messages with different stamps, s."""
  steps = np.diff(series.stamp)
  return steps[steps > 0.0]


def _drift(series: JointSeries) -> float:
  """Returns the slope of log time over stamp, less one."""
  if len(series.stamp) < 3 or np.ptp(series.stamp) <= 0:
    return 0.0
  return float(np.polyfit(series.stamp - series.stamp[0], series.log_time - series.stamp, 1)[0])


def _saturated(states: JointSeries) -> float:
  if states.effort is None:
    return 0.0
  size = np.abs(np.nan_to_num(states.effort))  # NaN: of a joint without
  top = size.max(axis=0)
  return round(float(np.mean(size > SETTINGS.saturated * np.maximum(top, 1e-12), axis=0).max()), 4)


def _warnings(log: Log, found: dict[str, Any]) -> list[str]:
  texts = []
  if found["state_gaps"] or found["command_gaps"]:
    texts.append(
      f"{log.name}: {found['state_gaps']} gaps in the states, {found['command_gaps']} in the"
      " commands."
    )
  if found["stale_share"] > _STALE:
    texts.append(f"{log.name}: {100 * found['stale_share']:.1f} % repeated readings are left out.")
  if abs(found["state_clock_drift"]) > _DRIFT:
    texts.append(
      f"{log.name}: the states' clock runs {1e6 * found['state_clock_drift']:.0f} ppm against the"
      " commands'."
    )
  if log.recovered:
    texts.append(f"{log.name}: damaged, only a part was read.")
  return texts
