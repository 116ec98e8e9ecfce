"""One joint of a MuJoCo model at a time: its surroundings as functions of time.

The other joints are prescribed: they move as they were measured. What remains for joint j is

    (I(t) + armature) dv/dt + g(t, q) + c(t) = actuator, friction, spring

with I = M_jj, gravity's torque g (a sine and cosine of a hinge's position, constant for a slide)
and c, what the other joints' velocities and accelerations demand. All of it is linear in the masses
and in gravity, so payloads and tilts are added as linear combinations without another pass.

Geared servos carry most of their inertia in their own rotors, which is why one joint at a time is a
good approximation; the figures of a report are simulated by the whole model.

Shapes: N samples of a log, J joints of the log, T grid points.
"""

import dataclasses

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model import point_mass

Array = np.ndarray

_EVERY = 3  # samples between poses at which a model is evaluated (30 ms at 100 Hz); ours
_REACH = 0.1  # m of the places at which a mass is put to see its moments
_UNIT = _REACH * np.eye(3)
_MONOMIALS_AT = np.array(
  [np.zeros(3), *_UNIT, *(-_UNIT), _UNIT[0] + _UNIT[1], _UNIT[0] + _UNIT[2], _UNIT[1] + _UNIT[2]]
)
_MONOMIALS = np.array(
  [[1, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z] for x, y, z in _MONOMIALS_AT]
)
_SMOOTHING = 0.035  # s, half width of the local polynomial that differentiates positions; ours


@dataclasses.dataclass(frozen=True)
class Surroundings:
  """What a joint feels of its model, at the samples of a log [N]."""

  inertia: Array
  """Without armature, kg m^2."""
  here: Array
  """Gravity's torque at `at`, to be overcome, N m."""
  across: Array
  """The same a quarter turn further; 0 for a slide."""
  at: Array
  """The joint's measured position, rad."""
  bias: Array
  """What the others' motion demands, N m."""

  def plus(self, other: "Surroundings", factor: float) -> "Surroundings":
    """Returns self + factor * other (the position stays)."""
    return Surroundings(
      self.inertia + factor * other.inertia,
      self.here + factor * other.here,
      self.across + factor * other.across,
      self.at,
      self.bias + factor * other.bias,
    )


@dataclasses.dataclass(frozen=True)
class Motion:
  """A log's joint motion, smoothed and differentiated."""

  time: Array
  """[N] s."""
  position: Array
  """[N, J]."""
  velocity: Array
  """[N, J]."""
  acceleration: Array
  """[N, J]."""


def smooth_motion(log: Log, *, half_width: float = _SMOOTHING) -> Motion:
  """Differentiates measured positions by local cubic fits in time (handles uneven stamps)."""
  time, position = log.states.stamp, log.states.position
  assert position is not None
  spacing = float(np.median(np.diff(time))) if len(time) > 1 else 0.01
  reach = max(2, round(half_width / max(spacing, 1e-6)))
  count = len(time)
  reach = min(reach, (count - 1) // 2)
  centre = np.clip(np.arange(count), reach, count - 1 - reach)
  index = centre[:, None] + np.arange(-reach, reach + 1)
  offset = (time[index] - time[:, None]) / half_width  # [N, K]
  powers = offset[..., None] ** np.arange(4)
  weight = np.maximum(1.0 - (offset / (np.abs(offset).max(axis=1, keepdims=True) * 1.05)) ** 2, 0)
  normal = np.einsum("nkp,nk,nkr->npr", powers, weight, powers)
  normal += 1e-9 * np.eye(4)
  right = np.einsum("nkp,nk,nkj->npj", powers, weight, position[index])
  fit = np.linalg.solve(normal, right)
  return Motion(time, fit[:, 0], fit[:, 1] / half_width, 2.0 * fit[:, 2] / half_width**2)


def start_velocity(log: Log) -> Array:
  """Returns the joints' velocity [J] at a log's first sample: 0 where they start from rest.

  A one-sided derivative at the start of a motion is wrong by the acceleration; logs begin at rest
  unless the first readings say otherwise.
  """
  position = log.states.position
  assert position is not None
  first = position[:4]
  slope = (first[1] - first[0]) / max(float(log.states.stamp[1] - log.states.stamp[0]), 1e-9)
  spread = np.ptp(position, axis=0) / max(log.duration, 1e-9)
  moving = np.abs(slope) > 2.0 * spread
  return np.where(moving, slope, 0.0)


class Reduction:
  """Computes the surroundings of joints of a model along a log."""

  def __init__(self, model: mujoco.MjModel, log: Log):
    """Prepares the poses.

    Args:
      model: compiled model; not changed for longer than a call.
      log: its joints are prescribed; joints that it lacks stay at the model's reference pose.
    """
    self.model, self.log = model, log
    self.motion = smooth_motion(log)
    self._data = mujoco.MjData(model)
    ids = [model.joint(name).id for name in log.joints]
    self._qpos = model.jnt_qposadr[ids]
    self._dofs = model.jnt_dofadr[ids]
    self._poses: point_mass.Poses | None = None
    self._moments: dict[int, dict[str, list[Surroundings]]] = {}

  def of_joint(self, joint: str) -> Surroundings:
    """Returns what a joint feels of the model as it is now."""
    model, data, motion = self.model, self._data, self.motion
    column = self.log.states.column(joint)
    index = model.joint(joint).id
    dof, address = int(model.jnt_dofadr[index]), int(model.jnt_qposadr[index])
    hinge = int(model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    count = len(motion.time)
    inertia, here, across, bias = np.zeros((4, count))
    full = np.zeros((model.nv, model.nv))
    alone = len(self.log.joints) == 1 and model.nv == 1
    others = np.arange(model.nv) != dof
    chosen = self._chosen()
    for n in chosen[:1] if alone else chosen:
      data.qpos[:] = model.qpos0
      data.qpos[self._qpos] = motion.position[n]
      if alone:
        data.qpos[address] = 0.0
      data.qvel[:] = 0.0
      mujoco.mj_fwdPosition(model, data)
      mujoco.mj_fullM(model, data, full)
      inertia[n] = full[dof, dof] - model.dof_armature[dof]
      acceleration = np.zeros(model.nv)
      acceleration[self._dofs] = motion.acceleration[n]
      coupling = float(full[dof, others] @ acceleration[others])
      mujoco.mj_fwdVelocity(model, data)
      here[n] = data.qfrc_bias[dof]
      if not alone:
        data.qvel[self._dofs] = motion.velocity[n]
        mujoco.mj_fwdVelocity(model, data)
        bias[n] = data.qfrc_bias[dof] - here[n] + coupling
      if hinge:
        data.qvel[:] = 0.0
        data.qpos[address] += np.pi / 2
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        across[n] = data.qfrc_bias[dof]
    if alone:
      inertia[:], here[:], across[:] = inertia[0], here[0], across[0]
      return Surroundings(inertia, here, across, np.zeros(count), bias)
    at = motion.position[:, column].copy()
    fields = np.array([inertia, here, across, bias])[:, chosen]
    return _between(chosen, at, fields, hinge=hinge)

  def moments(self, joint: str, body: int) -> list[Surroundings]:
    """Returns what mass and its moments on a body add, per unit.

    In the order 1, x, y, z, xx, yy, zz, xy, xz, yz: each is what a joint's surroundings gain per
    unit of mass times that monomial of its place in the body's frame.
    """
    if body not in self._moments:
      self._moments[body] = self._moments_of(body)
    if joint in self._moments[body]:
      return self._moments[body][joint]
    zero = np.zeros(len(self.motion.time))
    return [Surroundings(zero, zero, zero, self.of_joint(joint).at, zero)] * len(_MONOMIALS)

  def _moments_of(self, body: int) -> dict[str, list[Surroundings]]:
    """Returns the moments for all joints that carry a body."""
    model, motion, chosen = self.model, self.motion, self._chosen()
    count = len(motion.time)
    alone = len(self.log.joints) == 1 and model.nv == 1
    if alone:
      chosen = chosen[:1]
    positions = motion.position[chosen] * (not alone)
    if self._poses is None:
      self._poses = point_mass.Poses(model, self._qpos, positions)
    carrying = point_mass.carrying(model, body)
    names = [model.joint(k).name for k in carrying]
    velocity, acceleration = np.zeros((2, len(chosen), len(carrying)))
    for i, name in enumerate(names):
      if name in self.log.joints and not alone:
        column = self.log.states.column(name)
        velocity[:, i] = motion.velocity[chosen, column]
        acceleration[:, i] = motion.acceleration[chosen, column]
    values = []
    for place in _MONOMIALS_AT:
      point = self._poses.point(body, place)
      values.append(point_mass.added(self._poses, carrying, point, velocity, acceleration))
    solved = np.linalg.solve(_MONOMIALS, np.array(values).reshape(len(_MONOMIALS), -1))
    solved = solved.reshape(len(_MONOMIALS), len(carrying), 4, len(chosen))
    result = {}
    for i, name in enumerate(names):
      if name not in self.log.joints:
        continue
      hinge = self._poses.hinge(carrying[i])
      at = np.zeros(count) if alone else motion.position[:, self.log.states.column(name)].copy()
      result[name] = [_between(chosen, at, part, hinge=hinge) for part in solved[:, i]]
    return result

  def _chosen(self) -> Array:
    """Returns the samples at which the model is evaluated."""
    count = len(self.motion.time)
    return np.unique(np.append(np.arange(0, count, _EVERY), count - 1))

  def gravity(self, joint: str) -> list[Surroundings]:
    """Returns what gravity adds to a joint's surroundings per m/s^2 along the world's x, y, z."""
    model, before = self.model, self.model.opt.gravity.copy()
    try:
      model.opt.gravity[:] = 0.0
      base = self.of_joint(joint)
      parts = []
      for axis in range(3):
        model.opt.gravity[:] = np.eye(3)[axis]
        part = _stack(self.of_joint(joint), base)
        parts.append(Surroundings(part[0], part[1], part[2], base.at, part[3]))
      return parts
    finally:
      model.opt.gravity[:] = before


def _between(chosen: Array, at: Array, fields: Array, *, hinge: bool) -> Surroundings:
  """Returns surroundings at all samples from those at the chosen ones.

  Gravity is interpolated as a vector that turns with a hinge.

  Args:
    chosen: samples [M].
    at: position of the joint at all samples [N].
    fields: inertia, gravity here and across, and bias at the chosen ones [4, M].
    hinge: whether the joint is one.
  """
  inertia, here, across, bias = fields
  all_of = lambda values: np.interp(np.arange(len(at)), chosen, values)  # noqa: E731
  if hinge:
    cos, sin = np.cos(at), np.sin(at)
    c, s = cos[chosen], sin[chosen]
    x, y = all_of(here * c - across * s), all_of(here * s + across * c)
    here, across = x * cos + y * sin, y * cos - x * sin
  else:
    here, across = all_of(here), np.zeros(len(at))
  return Surroundings(all_of(inertia), here, across, at, all_of(bias))


def _stack(s: Surroundings, base: Surroundings) -> Array:
  """Returns [4, N] differences of inertia, gravity (two) and bias."""
  return np.array(
    [s.inertia - base.inertia, s.here - base.here, s.across - base.across, s.bias - base.bias]
  )
