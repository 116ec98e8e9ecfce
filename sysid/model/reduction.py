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
from nerf2real.suite.randomisation import inertia as masses

Array = np.ndarray

_EVERY = 3  # samples between poses at which a model is evaluated (30 ms at 100 Hz); ours
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
    chosen = np.unique(np.append(np.arange(0, count, _EVERY), count - 1))
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
    at = motion.position[:, column].copy()
    if not alone:  # gravity as a vector that turns with the joint, between the chosen samples
      cos, sin = np.cos(at), np.sin(at)
      fixed = np.array([here * cos - across * sin, here * sin + across * cos])
      fixed = np.array([np.interp(np.arange(count), chosen, f[chosen]) for f in fixed])
      if hinge:
        here, across = fixed[0] * cos + fixed[1] * sin, fixed[1] * cos - fixed[0] * sin
      else:
        here = np.interp(np.arange(count), chosen, here[chosen])
      inertia = np.interp(np.arange(count), chosen, inertia[chosen])
      bias = np.interp(np.arange(count), chosen, bias[chosen])
    if alone:
      inertia[:], here[:], across[:] = inertia[0], here[0], across[0]
      at[:] = 0.0
    return Surroundings(inertia, here, across, at, bias)

  def moments(self, joint: str, body: int) -> list[Surroundings]:
    """Returns what mass and its moments on a body add, per unit.

    In the order 1, x, y, z, xx, yy, zz, xy, xz, yz: each is what a joint's surroundings gain per
    unit of mass times that monomial of its place in the body's frame.
    """
    base = self.of_joint(joint)
    reach, added = 0.1, 0.2
    unit = np.eye(3) * reach
    places = [np.zeros(3), *unit, *(-unit)]
    places += [unit[0] + unit[1], unit[0] + unit[2], unit[1] + unit[2]]
    rows, values = [], []
    for place in places:
      x, y, z = place
      rows.append([1, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])
      values.append(_stack(self._with_mass(joint, body, added, place), base) / added)
    solved = np.linalg.solve(np.array(rows), np.array(values).reshape(len(rows), -1))
    solved = solved.reshape(len(rows), 4, -1)
    return [Surroundings(s[0], s[1], s[2], base.at, s[3]) for s in solved]

  def _with_mass(self, joint: str, body: int, mass: float, place: Array) -> Surroundings:
    model = self.model
    snapshot = masses.Snapshot(model)
    try:
      masses.attach_mass(model, body, added=mass, position=place)
      masses.refresh(model, mujoco.MjData(model), snapshot)
      return self.of_joint(joint)
    finally:
      snapshot.restore(model)

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


def _stack(s: Surroundings, base: Surroundings) -> Array:
  """Returns [4, N] differences of inertia, gravity (two) and bias."""
  return np.array(
    [s.inertia - base.inertia, s.here - base.here, s.across - base.across, s.bias - base.bias]
  )
