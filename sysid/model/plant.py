"""One joint of a declared model, ready to be simulated along measured logs by the compiled kernel.

Shapes: N samples of a log, B parameter sets, P parameters (`kernel.NAMES`).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model import kernel
from nerf2real.sysid.model.drive import actuator_of, holds_position
from nerf2real.sysid.model.measured import Measured, measured
from nerf2real.sysid.model.motion import start_velocity
from nerf2real.sysid.model.reduction import Reduction

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Windows:
  """Samples at which the simulation is set to the measured state."""

  start: Array
  position: Array
  velocity: Array


class Simulated(NamedTuple):
  """A simulated log at its samples."""

  position: Array
  """[N]."""
  velocity: Array
  """[N]."""
  torque: Array
  """[N] the actuator's."""


def declared_parameters(model: mujoco.MjModel, joint: str) -> Array:
  """Returns the kernel's parameters [P] of a joint as the model declares it."""
  values = dict.fromkeys(kernel.NAMES, 0.0) | kernel.NEUTRAL
  index = model.joint(joint).id
  dof = int(model.jnt_dofadr[index])
  values["armature"] = float(model.dof_armature[dof])
  values["damping"] = float(model.dof_damping[dof])
  values["friction"] = float(model.dof_frictionloss[dof])
  poly = np.ravel(model.dof_dampingpoly[dof])
  values["drag"] = float(poly[0]) if poly.size else 0.0
  values["stiffness"] = float(model.jnt_stiffness[index])
  values["reference"] = float(model.qpos_spring[model.jnt_qposadr[index]])
  impedance, rate = float(model.dof_solimp[dof, 0]), friction_rate(model, dof)
  values["softness"] = (1.0 - impedance) / impedance * float(model.dof_invweight0[dof])
  values["stopping_rate"] = rate
  values["lowest"], values["highest"] = -np.inf, np.inf
  euler = int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_EULER)
  values["servo_explicit"] = float(euler)
  u = actuator_of(model, joint)
  if u >= 0:
    gear = float(model.actuator_gear[u, 0])
    values["input"] = gear * float(model.actuator_gainprm[u, 0])
    if int(model.actuator_biastype[u]) != int(mujoco.mjtBias.mjBIAS_NONE):
      values["constant"] = gear * float(model.actuator_biasprm[u, 0])
      values["position"] = gear * gear * float(model.actuator_biasprm[u, 1])
      values["velocity"] = gear * gear * float(model.actuator_biasprm[u, 2])
    if model.actuator_forcelimited[u]:
      low, high = sorted(gear * model.actuator_forcerange[u])
      values["lowest"], values["highest"] = float(low), float(high)
    if model.jnt_actfrclimited[index]:
      low, high = model.jnt_actfrcrange[index]
      values["lowest"] = max(values["lowest"], float(low))
      values["highest"] = min(values["highest"], float(high))
  return np.array([values[name] for name in kernel.NAMES])


def friction_rate(model: mujoco.MjModel, dof: int) -> float:
  """Returns the rate [1/s] at which MuJoCo's friction constraint takes speed away.

  From solref, as in MuJoCo's documentation, "Solver parameters": b = 2 / (dmax timeconst), or the
  damping itself where solref is negative; a time constant is at least two steps.
  """
  time_constant, ratio = model.dof_solref[dof]
  limit = float(model.dof_solimp[dof, 1])
  if time_constant <= 0:
    return float(-ratio / limit)
  return float(2.0 / (limit * max(time_constant, 2 * model.opt.timestep)))


class JointPlant:
  """A joint of the declared model and what was measured of it in several logs."""

  def __init__(
    self,
    model: mujoco.MjModel,
    joint: str,
    logs: Sequence[Log],
    *,
    reductions: Sequence[Reduction] | None = None,
    window_s: float = 0.5,
  ):
    """Reduces the model along every log.

    Args:
      model: declared model.
      joint: name of a hinge or slide joint with an actuator.
      logs: measured logs.
      reductions: of the same logs, to share their work between joints.
      window_s: length of the windows that restart from the measured state where the actuator does
        not hold position.
    """
    self.model, self.joint = model, joint
    self.reductions = list(reductions or [Reduction(model, log) for log in logs])
    self.step = self.reductions[0].step
    self.declared = declared_parameters(model, joint)
    self.holds = holds_position(model, actuator_of(model, joint))
    index = model.joint(joint).id
    self.impedance = float(model.dof_solimp[model.jnt_dofadr[index], 1])
    self.inverse_weight = float(model.dof_invweight0[model.jnt_dofadr[index]])
    self.hinge = int(model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    self.logs = [
      measured(log, reduction.motion, joint, model)
      for log, reduction in zip(logs, self.reductions, strict=True)
    ]
    self.surroundings = [reduction.of_joint(joint) for reduction in self.reductions]
    self.windows = [
      self._windows(log, window_s, float(start_velocity(source)[source.states.column(joint)]))
      for log, source in zip(self.logs, logs, strict=True)
    ]
    self._grids = [reduction.time for reduction in self.reductions]
    self._loads = [
      np.interp(grid, log.time, _other_load(source, joint, log.time))
      for grid, log, source in zip(self._grids, self.logs, logs, strict=True)
    ]
    self._readings = [np.where(log.valid, log.position, np.nan) for log in self.logs]
    self._nominal = [(s.inertia, s.here, s.across, s.at, s.bias) for s in self.surroundings]
    lifts = [reduction.compensation(joint) for reduction in self.reductions]
    self._lifts = [
      None if s is None else turning((s.inertia, s.here, s.across, s.at, s.bias), self.hinge)[1:3]
      for s in lifts
    ]
    self._lifted_by_motor = bool(model.jnt_actgravcomp[index])

  @property
  def numerical_inertia(self) -> float:
    """Inertia, kg m^2 (or kg), that the scheme's step adds to the joint's.

    An implicit step has the force of damping at its end, half a step from its middle, as if half a
    step of it were mass; an explicit one has it at its start.
    """
    damping, servo = self.declared[kernel.INDEX["damping"]], self.declared[kernel.INDEX["velocity"]]
    explicit = self.declared[kernel.INDEX["servo_explicit"]] > 0
    return float(0.5 * self.step * (damping + (servo if explicit else -servo)))

  def _windows(self, log: Measured, window_s: float, first_velocity: float) -> Windows:
    if self.holds:
      return Windows(np.array([0]), log.position[:1].astype(float), np.array([first_velocity]))
    _, start = np.unique(np.floor((log.time - log.time[0]) / window_s), return_index=True)
    start = np.array([0, *[s for s in start[1:] if len(log.time) - s > 3]], np.int64)
    return Windows(start, log.position[start].astype(float), log.velocity[start])

  def _body(self, name: str) -> int:
    """Returns a body by its name, or by that of its joint."""
    index = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name)
    return index if index >= 0 else int(self.model.jnt_bodyid[self.model.joint(name).id])

  @property
  def logs_duty(self) -> bool:
    """Whether all logs hold the duty of an actuator that limits it."""
    limited = bool(np.isfinite(self.declared[kernel.INDEX["highest"]]))
    return self.holds and limited and all(log.duty is not None for log in self.logs)

  def declared_torque(self, *, of_current: bool = False) -> Array:
    """Returns the size of the declared actuator's torque over all logs [N], or of what of it is
    the current's, where the joint's damping is back-EMF."""
    outputs = [
      self._run(self.declared, i, turning(self._nominal[i], self.hinge), None)
      for i in range(len(self.logs))
    ]
    damping = self.declared[kernel.INDEX["damping"]] if of_current else 0.0
    return np.abs(np.concatenate([o.torque - damping * o.velocity for o in outputs]))

  def lift(self, index: int, offset: float) -> tuple[Array, Array] | None:
    """Returns what firmware lifts in a log where a joint is at 0 and a quarter turn further [T].

    Args:
      index: of the log.
      offset: what its encoder reads beyond the joint, which firmware does not know, rad (or m).
    """
    lift = self._lifts[index]
    return lift if lift is None or not self.hinge else turned_back(*lift, np.array(offset))

  def _run(
    self,
    p: Array,
    index: int,
    grid: tuple[Array, ...],
    table: tuple[Array, Array] | None,
    readings: Array | None = None,
  ) -> Simulated:
    log, windows = self.logs[index], self.windows[index]
    lift = self.lift(index, p[kernel.INDEX["encoder_offset"]])
    if lift is not None:
      inertia, zero, quarter, bias = grid
      grid = inertia, zero - lift[0], quarter - lift[1], bias
    readings = self._readings[index] if readings is None else readings
    times = (log.command_time, log.command, log.time)
    out = simulated(
      p, self.step, times, (*grid, self._loads[index]), self.hinge, windows, readings, table
    )
    if lift is not None and self._lifted_by_motor:
      zero, quarter = (np.interp(log.time, self._grids[index], part) for part in lift)
      at = out[0] - p[kernel.INDEX["encoder_offset"]]
      out[2] += turned_back(zero, quarter, at)[0] if self.hinge else zero
    return Simulated(*out)


def simulated(
  p: Array,
  step: float,
  times: tuple[Array, Array, Array],
  fields: Sequence[Array],
  hinge: bool,
  windows: Windows,
  readings: Array,
  table: tuple[Array, Array] | None,
) -> Array:
  """Returns position, velocity and torque [3, N] of one run of the kernel.

  Args:
    p: kernel parameters [P].
    step: s.
    times: of commands, the commands, times of the samples.
    fields: inertia, gravity at 0 and a quarter turn further, bias, other actuators' load, each [T].
    hinge: whether gravity turns with the joint.
    windows: where the state is set anew.
    readings: that it follows where it is told to.
    table: a force over position and velocity; None for none.
  """
  out = np.zeros((3, len(times[2])))
  weights, bounds = table if table is not None else (np.zeros((0, 0)), np.zeros(4))
  begin = (windows.start, windows.position, windows.velocity)
  kernel.simulate(  # type: ignore
    kernel.record(p),
    step,
    *times,
    *fields,  # type: ignore[arg-type]
    hinge,
    *begin,
    readings,
    weights,
    bounds,
    *out,
  )
  return out


def turning(fields: Sequence[Array], hinge: bool) -> tuple[Array, Array, Array, Array]:
  """Returns inertia, gravity's torque at position 0 and a quarter turn further, and bias, each [T].

  Args:
    fields: inertia, gravity here, across, the position where that is, and bias, each [T].
    hinge: whether gravity turns with the joint; a slide has the same everywhere.
  """
  inertia, here, across, at, bias = fields
  if not hinge:
    return inertia, here, across, bias
  cosine, sine = np.cos(at), np.sin(at)
  return inertia, here * cosine - across * sine, here * sine + across * cosine, bias


def turned_back(zero: Array, quarter: Array, at: Array) -> tuple[Array, Array]:
  """Returns gravity's torque [T] at positions `at` and a quarter turn further, from `turning`'s."""
  cosine, sine = np.cos(at), np.sin(at)
  return zero * cosine + quarter * sine, quarter * cosine - zero * sine


def _other_load(log: Log, joint: str, time: Array) -> Array:
  """Returns the sum of the other joints' |effort| [N] where efforts were measured, else zeros; NaN,
  of a joint without, counts as none."""
  if log.states.effort is None or len(log.states.joints) == 1:
    return np.zeros(len(time))
  others = [i for i, name in enumerate(log.states.joints) if name != joint]
  return np.nansum(np.abs(log.states.effort[:, others]), axis=1)
