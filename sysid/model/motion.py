"""A log's joint motion: positions smoothed and differentiated, with more detail than readings hold.

Where a command jumps, acceleration jumps within a step of the simulation; readings every 10 ms with
noise show that smeared over some 40 ms. What smoothing takes away is told by the declared model:
along the smoothed motion, its accelerations under the logged commands make a path of their own,
and what smoothing takes away from that path is given back to the measured one, as late and as
large as what smoothing took away from the readings says (a regression). Of a model that is wrong,
or whose commands do not jump, nothing is given back.

Shapes: N samples of a log, J joints of the log, T points of the grid, K neighbours.
"""

import dataclasses

import mujoco
import numpy as np
from mujoco import rollout
from scipy.stats import norm

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model.drive import Told, actuator_of

Array = np.ndarray

_START = 0.011  # s within which the first readings tell a velocity: two readings at 100 Hz; chosen
_SMOOTHING = 0.035  # s, half width of the local polynomial that differentiates positions; chosen
_LATEST = 0.25  # s that a machine's motion is looked for behind its commands, as late commands are
_APART = 1e-3  # s between what it is tried to be late by, of steps that are shorter; chosen
_CLEARLY = 0.9  # of what the best lateness explains: the earliest peak is taken that does; chosen
_LARGEST = 2.0  # times what the model says smoothing takes away; chosen


@dataclasses.dataclass(frozen=True)
class Motion:
  """Joint motion over time."""

  time: Array
  """[N] s."""
  position: Array
  """[N, J]."""
  velocity: Array
  """[N, J]."""
  acceleration: Array
  """[N, J]."""

  def at(self, time: Array) -> "Motion":
    """Returns the motion at other times, linear between its own."""

    def between(values: Array) -> Array:
      return np.array([np.interp(time, self.time, column) for column in values.T]).T

    return Motion(time, between(self.position), between(self.velocity), between(self.acceleration))


class Smoother:
  """Local cubic fits in time, the same linear map for any positions at the same stamps."""

  def __init__(self, time: Array, half_width: float = _SMOOTHING):
    """Prepares the fits for stamps [N], uneven ones, too."""
    self.time = time
    spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.01
    reach = max(2, round(half_width / max(spacing, 1e-6)))
    count = len(time)
    reach = min(reach, (count - 1) // 2)
    centre = np.clip(np.arange(count), reach, count - 1 - reach)
    self._index = centre[:, None] + np.arange(-reach, reach + 1)
    offset = (time[self._index] - time[:, None]) / half_width  # [N, K]
    powers = offset[..., None] ** np.arange(4)
    weight = np.maximum(1.0 - (offset / (np.abs(offset).max(axis=1, keepdims=True) * 1.05)) ** 2, 0)
    normal = np.einsum("nkp,nk,nkr->npr", powers, weight, powers)
    normal += 1e-9 * np.eye(4)
    scale = np.array([1.0, 1.0 / half_width, 2.0 / half_width**2])[:, None]
    solved = np.linalg.solve(normal, np.einsum("nkp,nk->npk", powers, weight))
    self._maps = solved[:, :3] * scale  # [N, 3, K]

  def motion(self, position: Array) -> Motion:
    """Returns the motion of positions [N, J]."""
    fit = np.einsum("npk,nkj->npj", self._maps, position[self._index])
    return Motion(self.time, fit[:, 0], fit[:, 1], fit[:, 2])

  def taken(self, position: Array) -> Array:
    """Returns what smoothing takes away from positions [N, J]."""
    return position - np.einsum("nk,nkj->nj", self._maps[:, 0], position[self._index])


def smooth_motion(log: Log, *, half_width: float = _SMOOTHING) -> Motion:
  """Differentiates measured positions by local cubic fits in time (handles uneven stamps)."""
  assert log.states.position is not None
  return Smoother(log.states.stamp, half_width).motion(log.states.position)


def start_velocity(log: Log) -> Array:
  """Returns the joints' velocity [J] at a log's first sample: 0 where they start from rest.

  A one-sided derivative at the start of a motion is wrong by the acceleration; logs begin at rest
  unless the first readings say otherwise, by more than three times what their noise does.
  """
  position, stamp = log.states.position, log.states.stamp
  assert position is not None
  count = max(2, int(np.searchsorted(stamp, stamp[0] + _START, side="right")))
  apart = stamp[:count] - stamp[:count].mean()
  reach = float(apart @ apart)
  if reach == 0.0:
    return np.zeros(position.shape[1])
  slope = apart @ position[:count] / reach
  spread = np.ptp(position, axis=0) / max(log.duration, 1e-9)
  # third differences of noise have 20 times its square
  third = np.abs(np.diff(position, n=3, axis=0))
  noise = np.median(third, axis=0) / norm.ppf(0.75) / np.sqrt(20.0) if len(third) else 0.0
  moving = np.abs(slope) > np.maximum(2.0 * spread, 3.0 * noise / np.sqrt(reach))
  return np.where(moving, slope, 0.0)


def detailed_motion(model: mujoco.MjModel, log: Log, grid: Array) -> Motion:
  """Returns a log's motion on a fine grid, with what smoothing takes away as the model tells it.

  Args:
    model: declared model; restored before returning.
    log: measured.
    grid: evenly spaced times [T], s, within which the log's stamps lie.
  """
  measured, step = log.states.position, float(grid[1] - grid[0])
  assert measured is not None
  smoother = Smoother(log.states.stamp)
  smooth = smoother.motion(measured)
  along, taken = smooth.at(grid), measured - smooth.position
  latest = round(min(_LATEST, 0.5 * grid[-1]) / step)
  late = np.zeros(measured.shape[1], int)
  told = _declared(model, log, along, late)
  for j, column in enumerate(taken.T):
    tried = np.arange(0, latest + 1, max(1, round(_APART / step)))
    gains, shares = _gains(smoother, told, j, tried, column)
    explained = gains * shares
    peaks = explained >= np.maximum(np.append(explained[1:], 0.0), np.append(0.0, explained[:-1]))
    late[j] = tried[np.argmax(peaks & (explained >= _CLEARLY * explained.max()))]
  told = _declared(model, log, along, late)
  fields = [along.position.copy(), along.velocity.copy(), along.acceleration.copy()]
  smoothed = smoother.motion(told.at(smoother.time).position).at(grid)
  for j, column in enumerate(taken.T):
    gain = _gains(smoother, told, j, np.zeros(1), column)[0][0]
    details = (
      told.position - smoothed.position,
      told.velocity - smoothed.velocity,
      told.acceleration - smoothed.acceleration,
    )
    for field, detail in zip(fields, details, strict=True):
      field[:, j] += gain * detail[:, j]
  return Motion(grid, *fields)


def _gains(
  smoother: Smoother, told: Motion, joint: int, late: Array, taken: Array
) -> tuple[Array, Array]:
  """Returns by how much what smoothing takes from a path told is what it takes from readings.

  Args:
    smoother: of the readings.
    told: a path on the grid.
    joint: its column.
    late: points of the grid by which the readings are later [L].
    taken: what smoothing takes from the joint's readings [N].

  Returns:
    The factors [L], from 0 to `_LARGEST`, and how much the two go with each other [L].
  """
  step = told.time[1] - told.time[0]
  times = smoother.time[:, None] - late * step
  missing = smoother.taken(np.interp(times, told.time, told.position[:, joint]))
  shares = taken @ missing
  squares = np.maximum(np.sum(missing**2, axis=0), 1e-30)
  return np.clip(shares / squares, 0.0, _LARGEST), shares


def _declared(model: mujoco.MjModel, log: Log, motion: Motion, late: Array) -> Motion:
  """Returns the path that a model's accelerations along a motion make, under a log's commands.

  From one step of the simulation at each point of the grid, so that damping acts as there. The
  path drifts, as nothing holds it; what is used of it is what smoothing takes away.

  Args:
    model: restored before returning.
    log: its commands.
    motion: of its joints on the grid.
    late: points of the grid by which the commands of each joint come late [J].
  """
  step = float(motion.time[1] - motion.time[0])
  late_by = np.zeros(model.nu)
  for name, points in zip(log.joints, late, strict=True):
    if name in log.commands.joints:
      late_by[actuator_of(model, name)] = points * step
  ids = [model.joint(name).id for name in log.joints]
  qpos, dofs = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
  own, flags = float(model.opt.timestep), int(model.opt.disableflags)
  try:
    model.opt.timestep = step
    model.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    states = np.repeat(state[None], len(motion.time), axis=0)
    states[:, 1 + qpos] = motion.position
    states[:, 1 + model.nq + dofs] = motion.velocity
    control = Told(model, log).mean(motion.time, step, late_by)
    after, _ = rollout.rollout(model, data, states, control[:, None])
  finally:
    model.opt.timestep, model.opt.disableflags = own, flags
  acceleration = (after[:, 0, 1 + model.nq + dofs] - motion.velocity) / step
  velocity = step * np.cumsum(acceleration, axis=0)
  position = step * np.cumsum(velocity, axis=0)
  # the state at a point is that before the step from there on
  velocity = np.vstack([np.zeros_like(velocity[:1]), velocity[:-1]])
  position = np.vstack([np.zeros_like(position[:1]), position[:-1]])
  return Motion(motion.time, position, velocity, acceleration)
