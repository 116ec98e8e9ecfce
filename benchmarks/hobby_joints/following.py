"""How far a declared model strays from a log: MuJoCo under the log's commands."""

import mujoco
import numpy as np

Array = np.ndarray
LEAD = 1.5
"""s for which machine and model hold the first command before a log begins."""


def follow(xml: str, sent: Array, commands: Array, times: Array, latency: float = 0.0) -> Array:
  """Returns positions [N, n] of the model.

  Args:
    xml: MJCF, actuators in the order of the joints.
    sent: when commands were sent [M] s.
    commands: [M, n].
    times: of the readings [N] s.
    latency: s, from a command to a reading of what it did.
  """
  model = mujoco.MjModel.from_xml_string(xml)
  data, step = mujoco.MjData(model), model.opt.timestep
  data.qpos[:] = commands[0]
  grid = np.arange(-LEAD, times[-1] + 2.0 * step, step)
  heard = np.maximum(np.searchsorted(sent + latency, grid + 0.5 * step) - 1, 0)
  course = np.empty((grid.size, model.nq))
  for k, which in enumerate(heard):
    course[k] = data.qpos
    data.ctrl[:] = commands[which]
    mujoco.mj_step(model, data)
  return at(times, grid, course)


def at(times: Array, grid: Array, course: Array) -> Array:
  """Returns a course [G, n] at other times [N, n]."""
  return np.stack([np.interp(times, grid, column) for column in course.T], 1)


def error(course: Array, readings: Array) -> float:
  """Returns the RMS of what readings [N, n] differ by from a course [N, n]."""
  return float(np.sqrt(np.mean((course - readings) ** 2)))
