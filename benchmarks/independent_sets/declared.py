"""How far a recording is from its declared model: MuJoCo rolls the model out under its commands.

Whole logs where actuators hold position, else windows that begin at the measured state, as the
error of `sysid` is defined.
"""

import mujoco
import numpy as np
from mujoco import rollout
from scipy.signal import savgol_filter

from benchmarks.independent_sets.recording import Recording

WINDOW = 0.5
"""s."""
_SMOOTHING = 0.06  # s, of the parabola that a start's velocity is read from
_LAGS = 1e-3 * np.arange(6)  # s, of controllers, filters and the current loop


def lag(xml: str, recorded: Recording, *, whole: bool) -> float:
  """Returns the lateness of commands [s] with which the declared model fits a recording best."""
  errors = [float(np.sum(error(xml, recorded, whole=whole, late=late) ** 2)) for late in _LAGS]
  return float(_LAGS[int(np.argmin(errors))])


def error(xml: str, recorded: Recording, *, whole: bool, late: float = 0.0) -> np.ndarray:
  """Returns the RMSE of positions [n] of a declared model on a recording.

  Args:
    xml: the declared model.
    recorded: what was logged.
    whole: simulate the whole log, not windows.
    late: s that the model receives commands late.
  """
  model = mujoco.MjModel.from_xml_string(xml)
  step, first = model.opt.timestep, float(recorded.stamp[0])
  span = float(recorded.stamp[-1]) - first
  starts = np.array([first]) if whole else first + np.arange(0.0, span - WINDOW, WINDOW)
  count = int(np.ceil((span if whole else WINDOW) / step)) + 1
  grid = np.arange(first, recorded.stamp[-1], step)
  place = np.stack([np.interp(grid, recorded.stamp, column) for column in recorded.position.T])
  speed = savgol_filter(place, round(_SMOOTHING / step) | 1, 2, deriv=1, delta=step, axis=1)
  full = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
  data = mujoco.MjData(model)
  states = np.zeros((len(starts), mujoco.mj_stateSize(model, full)))
  controls = np.zeros((len(starts), count, model.nu))
  for index, start in enumerate(starts):
    at = min(round((start - first) / step), len(grid) - 1)
    data.qpos[:], data.qvel[:] = place[:, at], speed[:, at]
    mujoco.mj_getState(model, data, states[index], full)
    times = start + step * np.arange(count)
    held = np.searchsorted(recorded.command_time + late, times, side="right") - 1
    controls[index] = recorded.command[np.maximum(held, 0)]
  found, _ = rollout.rollout(model, data, states, controls)
  squares: list[np.ndarray] = []
  for index, start in enumerate(starts):
    inside = (recorded.stamp > start) & (recorded.stamp < start + step * (count - 1))
    times = start + step * (1 + np.arange(count))
    predicted = [
      np.interp(recorded.stamp[inside], times, found[index, :, 1 + joint])
      for joint in range(model.nq)
    ]
    squares.append((recorded.position[inside] - np.stack(predicted, axis=1)) ** 2)
  return np.sqrt(np.mean(np.concatenate(squares), axis=0))
