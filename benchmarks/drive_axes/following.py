"""How far a declared model strays from a log: MuJoCo's simulation under the log's commands."""

import mujoco
import numpy as np

Array = np.ndarray
LEAD = 1.5
"""s for which the model holds its first command before the log begins."""


def follow(xml: str, sent: Array, commands: Array, times: Array, latency: float = 0.0) -> Array:
  """Returns positions [N, n] of the model at times [N] s.

  Args:
    xml: MJCF whose actuators take the commands in the order of the joints.
    sent: when commands were sent [M] s.
    commands: [M, n].
    times: of the readings, from 0.
    latency: s, from a command to a reading of what it did, both as stamped.
  """
  model = mujoco.MjModel.from_xml_string(xml)
  data = mujoco.MjData(model)
  data.qpos[:] = commands[0]
  step = model.opt.timestep
  grid = np.arange(-LEAD, times[-1] + 2 * step, step)
  held = np.clip(np.searchsorted(sent + latency, grid + 0.5 * step) - 1, 0, None)
  course = np.empty((grid.size, model.nq))
  for k, which in enumerate(held):
    course[k] = data.qpos
    data.ctrl[:] = commands[which]
    mujoco.mj_step(model, data)
  return np.stack([np.interp(times, grid, column) for column in course.T], 1)


def error(course: Array, readings: Array) -> float:
  """Returns the RMS of what readings [N, n] differ by from the model's course [N, n]."""
  return float(np.sqrt(np.mean((course - readings) ** 2)))
