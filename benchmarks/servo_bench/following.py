"""How a declared model follows commands, by MuJoCo: what errors are measured against."""

from typing import NamedTuple

import mujoco
import numpy as np

from benchmarks.servo_bench.recording import LEAD, Recording

Array = np.ndarray


class Course(NamedTuple):
  """A model's motion from rest at the first command."""

  time: Array  # [T] s
  angle: Array  # [T] rad


def follow(xml: str, command_time: Array, command: Array, latency: float = 0.0) -> Course:
  """Returns how a model moves.

  Args:
    xml: MJCF of one joint with one position actuator.
    command_time: [M] s.
    command: [M] rad, held until the next.
    latency: s, by which the model hears them later.
  """
  model = mujoco.MjModel.from_xml_string(xml)
  data = mujoco.MjData(model)
  data.qpos[0] = command[0]
  step = model.opt.timestep
  count = round((LEAD + command_time[-1] + 0.1) / step)
  time = step * np.arange(1, count + 1) - LEAD
  heard = np.searchsorted(command_time + latency, time - step + 1e-9, side="right") - 1
  goals = command[np.maximum(heard, 0)].tolist()
  angle = np.empty(count)
  for k, goal in enumerate(goals):
    data.ctrl[0] = goal
    mujoco.mj_step(model, data)
    angle[k] = data.qpos[0]
  return Course(time, angle)


def error(course: Course, log: Recording) -> float:
  """Returns the RMS [rad] of a log's readings about a model's course."""
  apart = log.angle - np.interp(log.stamp, course.time, course.angle)
  return float(np.sqrt(np.mean(apart**2)))
