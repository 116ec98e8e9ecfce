"""The error of a model with effects on a log, simulated by MuJoCo and `suite.effects`.

Whole logs are simulated where all actuators hold position; else windows restart from the measured
state. Shapes: N samples, J joints of the log, U actuators.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import rollout

from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.sysid.model.drive import Told, actuator_of, holds_position, joint_of
from nerf2real.sysid.model.measured import fresh
from nerf2real.sysid.model.motion import smooth_motion, start_velocity

Array = np.ndarray


_SENSORS = ("imu_", "camera_")  # kinds that move no joint
_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
_SPOILT = 1.02  # times the declared model's error: beyond rounding and the scatter of a fit; ours


def is_worse(error: Mapping[str, float]) -> bool:
  """Tells whether errors {"before", "after"} say that an extended model is worse."""
  return error["after"] > _SPOILT * error["before"]


@dataclasses.dataclass(frozen=True)
class Clocks:
  """Latencies of one joint that are no effects: see `constants.constants`."""

  skew: float = 0.0
  """s that a position is older than its stamp."""
  latency: float = 0.0
  """s that a command takes to the actuator."""


class Member(NamedTuple):
  """A model to simulate with: effects and latencies."""

  effects: Sequence[Effect]
  clocks: dict[str, Clocks]
  weight: int = 1
  """Of its prediction in the mean of several."""


def merge_delays(
  effects: Sequence[Effect], clocks: dict[str, Clocks], model: mujoco.MjModel
) -> list[Effect]:
  """Returns the effects with every joint's latency added to its command delay."""
  result = [e for e in effects if e.kind != "command_delay"]
  named = {e.target: float(e.parameters["delay"]) for e in effects if e.kind == "command_delay"}  # type: ignore[arg-type]
  common = named.get(None, 0.0)
  for u in range(model.nu):
    joint = joint_of(model, u)
    if joint is None:
      continue
    total = named.get(joint, common) + clocks.get(joint, Clocks()).latency
    if total > 0:
      result.append(Effect("command_delay", joint, {"delay": total}))
  return result


def simulate(
  model: mujoco.MjModel,
  log: Log,
  effects: Sequence[Effect] = (),
  *,
  clocks: dict[str, Clocks] | None = None,
  window_s: float = 0.5,
) -> Array:
  """Returns the positions [N, J] that a model with effects gives at the stamps of a log's states.

  Args:
    model: compiled model; restored before returning.
    log: its commands drive the model.
    effects: what the model lacks.
    clocks: by joint.
    window_s: length of windows where an actuator does not hold position.
  """
  clocks = clocks or {}
  measured = log.states.position
  assert measured is not None
  ids = [model.joint(name).id for name in log.joints]
  qpos, dofs = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
  actuators = [actuator_of(model, name) for name in log.commands.joints]
  holds = all(holds_position(model, u) for u in actuators)
  time = log.states.stamp
  motion = smooth_motion(log)
  starts = [0]
  if not holds:
    window = np.floor((time - time[0]) / window_s)
    starts = [int(s) for s in np.unique(window, return_index=True)[1]]
  delays = merge_delays(effects, clocks, model)
  late_by = _delays(delays, model)
  moving = [e for e in delays if e.kind != "command_delay" and not e.kind.startswith(_SENSORS)]
  told = Told(model, log)
  filters = np.isin(model.actuator_dyntype, _FILTERS)  # begin settled at what they are told
  stack = EffectStack(moving).bind(model)
  try:
    rate = _of_joint(effects, "clock_drift", "rate", None)
    offset = np.array([_of_joint(effects, "encoder_offset", "offset", n) for n in log.joints])
    step = float(model.opt.timestep)
    late = np.array([_of_joint(effects, "measurement_delay", "delay", n) for n in log.joints])
    late += [clocks.get(name, Clocks()).skew for name in log.joints]
    data = mujoco.MjData(model)
    result = np.zeros_like(measured)
    for index, start in enumerate(starts):
      end = starts[index + 1] if index + 1 < len(starts) else len(time)
      mujoco.mj_resetData(model, data)
      data.qpos[qpos] = measured[start] - offset
      data.qvel[dofs] = start_velocity(log) if holds else motion.velocity[start]
      first = time[start] / (1 + rate)
      count = int(np.ceil((time[end - 1] / (1 + rate) - first - late.min()) / step)) + 2
      data.time = first
      times = first + step * np.arange(count + 1)
      ctrl = told.mean(times[:-1], step, late_by)
      data.act[model.actuator_actadr[filters]] = ctrl[0, model.actuator_ctrladr[filters]]
      history = np.vstack([data.qpos[qpos], _roll(stack, data, ctrl, qpos)])
      for j in range(len(ids)):
        stamps = time[start:end] / (1 + rate) - late[j]
        result[start:end, j] = np.interp(stamps, times, history[:, j]) + offset[j]
  finally:
    stack.unbind()
  return result


def _roll(stack: EffectStack, data: mujoco.MjData, ctrl: Array, qpos: Array) -> Array:
  """Returns the joints' readings [T, J] after each step under commands [T, U]."""
  assert stack.binding is not None
  model = stack.binding.model
  if stack.is_constant:
    start = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states, _ = rollout.rollout(model, data, start[None], ctrl[None])
    return states[0][:, 1 + qpos]
  stack.reset()
  on_motor = _backlash_of(stack)
  history = np.empty((len(ctrl), len(qpos)))
  for n, row in enumerate(ctrl):
    stack.before_step(data, row)
    mujoco.mj_step(model, data)
    history[n] = data.qpos[qpos]
    if on_motor is not None:
      history[n] += on_motor.observe("joint_positions", np.zeros(len(qpos)), data.time)
  return history


def _delays(effects: Sequence[Effect], model: mujoco.MjModel) -> Array:
  """Returns the command delay of every actuator [U], s."""
  result = np.zeros(model.nu)
  for u in range(model.nu):
    joint = joint_of(model, u)
    result[u] = 0.0 if joint is None else _of_joint(effects, "command_delay", "delay", joint)
  return result


def _backlash_of(stack: EffectStack):
  """Returns the backlash operator where an encoder sits on the motor, else None."""
  on_motor = any(
    e.kind == "backlash" and e.parameters.get("encoder_on_motor") for e in stack.effects
  )
  return stack.operator("backlash") if on_motor else None


def _of_joint(effects: Sequence[Effect], kind: str, name: str, joint: str | None) -> float:
  """Returns an effect's value on a joint; one on the joint itself replaces one on all."""
  chosen = [e for e in effects if e.kind == kind and e.target in (None, joint)]
  chosen.sort(key=lambda e: e.target is None)
  return float(chosen[0].parameters[name]) if chosen else 0.0  # type: ignore[arg-type]


def error(
  model: mujoco.MjModel,
  logs: Sequence[Log],
  effects: Sequence[Effect] = (),
  *,
  clocks: dict[str, Clocks] | None = None,
  window_s: float = 0.5,
) -> float:
  """Returns the RMSE of positions over logs and the joints that they command, rad (or m); readings
  that were repeated while the joint moved are left out: they measure nothing. See `simulate`."""
  courses = [simulate(model, log, effects, clocks=clocks, window_s=window_s) for log in logs]
  return _rmse(logs, courses)


def errors(
  model: mujoco.MjModel, logs: Sequence[Log], members: Sequence[Member], *, window_s: float = 0.5
) -> dict[str, float]:
  """Returns the RMSE of the model, and of the weighed mean of several models' predictions, over the
  joints that the logs command, rad (or m).

  Args:
    model: compiled model.
    logs: measured.
    members: models; the first one alone is written as MJCF.
    window_s: length of windows where an actuator does not hold position.

  Returns:
    "before", "after", and where there are several models "single", that of the first, "median",
    "least" and "most" of them, and "models", how many they are.
  """
  courses = [
    [simulate(model, log, m.effects, clocks=m.clocks, window_s=window_s) for log in logs]
    for m in members
  ]
  result = {"before": error(model, logs, window_s=window_s)}
  weights = [m.weight for m in members]
  mean = [np.average(c, axis=0, weights=weights) for c in zip(*courses, strict=True)]
  result["after"] = _rmse(logs, mean)
  if len(members) > 1:
    each = [_rmse(logs, c) for c in courses]
    result |= {"single": each[0], "median": float(np.median(each)), "least": min(each)}
    result |= {"most": max(each), "models": len(each)}
  return result


def _rmse(logs: Sequence[Log], courses: Sequence[Array]) -> float:
  """Returns the RMSE of simulated courses [N, J] a log over new readings of commanded joints."""
  squares = []
  for log, positions in zip(logs, courses, strict=True):
    assert log.states.position is not None
    measured, speeds = log.states.position, smooth_motion(log).velocity
    for column in (log.states.column(j) for j in log.joints if j in log.commands.joints):
      kept = fresh(log.states.stamp, measured[:, column], speeds[:, column])
      squares.append(np.square((measured - positions)[kept, column]))
  return float(np.sqrt(np.mean(np.concatenate(squares))))
