"""The sample log `examples/servo` with `mujoco.sysid`: the parameters that its user would free.

`mujoco.sysid` fits parameters of the declared model (here damping, armature, dry friction and gain)
by nonlinear least squares over whole simulated logs. Figures: fitted values with half widths of
their 95 % intervals, and the error on the logs that were not fitted, declared and fitted.
`launch/identify.py` on the same logs says which effect the model lacks.

  pip install 'mujoco[sysid]'
  python benchmarks/mujoco_sysid.py
"""

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks import harness
from nerf2real.core.robot_logs.reading import Log, read_log

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "examples" / "servo"
_JOINT = "joint"
# by name: its types would make mypy read mujoco itself, which has none
sysid: Any = importlib.import_module("mujoco.sysid")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the comparison."""

  iterations: int = 12
  """Of the optimiser at most."""


def model_spec() -> mujoco.MjSpec:
  """Returns the declared model with a sensor of the joint's position."""
  spec = mujoco.MjSpec.from_file(str(SAMPLE / "model.xml"))
  spec.add_sensor(
    name="position",
    type=mujoco.mjtSensor.mjSENS_JOINTPOS,
    objtype=mujoco.mjtObj.mjOBJ_JOINT,
    objname=_JOINT,
  )
  return spec


def on_steps(log: Log, timestep: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns times [T] [s], held commands [T] and interpolated readings [T] [rad] at the steps."""
  states, commands = log.states, log.commands
  assert states.position is not None and commands.position is not None
  begin, end = max(states.stamp[0], commands.stamp[0]), min(states.stamp[-1], commands.stamp[-1])
  times = np.arange(begin, end, timestep)
  held = np.searchsorted(commands.stamp, times, side="right") - 1
  measured = np.interp(times, states.stamp, states.position[:, 0])
  return times - begin, commands.position[held, 0], measured


def sequences(logs: list[Log]) -> Any:
  """Returns logs as `mujoco.sysid` reads them; the first reading is the initial state."""
  spec = model_spec()
  model = spec.compile()
  starts, controls, readings = [], [], []
  for log in logs:
    times, commands, measured = on_steps(log, model.opt.timestep)
    starts.append(sysid.create_initial_state(model, measured[:1]))
    controls.append(sysid.TimeSeries.from_control_names(times, commands[:, None], model))
    readings.append(sysid.TimeSeries.from_names(times, measured[:, None], model))
  return sysid.ModelSequences("servo", spec, [log.name for log in logs], starts, controls, readings)


def parameters() -> Any:
  """Returns the model's own parameters of joint and servo, free within wide bounds."""
  declared = model_spec().compile()
  joint, actuator = declared.joint(_JOINT), declared.actuator(_JOINT)

  def of_joint(name: str) -> Callable[[mujoco.MjSpec, Any], None]:
    return lambda spec, p: setattr(spec.joint(_JOINT), name, _like(spec.joint(_JOINT), name, p))

  def gain(spec: mujoco.MjSpec, p: Any) -> None:
    spec.actuator(_JOINT).gainprm[0], spec.actuator(_JOINT).biasprm[1] = p.value[0], -p.value[0]

  found = sysid.ParameterDict()
  dof = int(joint.dofadr[0])
  for name, value, low, high in (
    ("damping", declared.dof_damping[dof], 0.0, 5.0),
    ("armature", declared.dof_armature[dof], 0.001, 0.2),
    ("frictionloss", declared.dof_frictionloss[dof], 0.0, 0.5),
  ):
    found.add(sysid.Parameter(name, value, low, high, modifier=of_joint(name)))
  kp = float(actuator.gainprm[0])
  found.add(sysid.Parameter("kp", kp, 0.2 * kp, 5 * kp, modifier=gain))
  return found


def _like(element: object, name: str, p: Any) -> object:
  """Returns an element's attribute with the value; of coefficients the first, the linear one."""
  before = np.array(getattr(element, name), np.float64)
  if before.ndim == 0:
    return float(p.value[0])
  before.flat[0] = p.value[0]
  return before


def rmse(logs: list[Log], chosen: Any) -> float:
  """Returns the RMSE of the position over whole logs, simulated from their first reading [rad]."""
  model = sysid.apply_param_modifiers(chosen, model_spec())
  squares = []
  for log in logs:
    _, commands, measured = on_steps(log, model.opt.timestep)
    data = mujoco.MjData(model)
    data.qpos[0] = measured[0]
    for command, position in zip(commands, measured, strict=True):
      squares.append((data.qpos[0] - position) ** 2)
      data.ctrl[0] = command
      mujoco.mj_step(model, data)
  return float(np.sqrt(np.mean(squares)))


def main(settings: Settings) -> int:
  """Fits, and prints what was found."""
  train, held = (
    [read_log(path) for path in sorted(SAMPLE.glob(f"{kind}_*.mcap"))] for kind in ("train", "held")
  )
  declared = parameters()
  residual = sysid.build_residual_fn(models_sequences=[sequences(train)])
  chosen, result = sysid.optimize(declared, residual, verbose=False, max_iters=settings.iterations)
  residuals, *_ = residual(chosen.as_vector(), chosen)
  _, widths = sysid.calculate_intervals(residuals, result.jac)
  values: dict[str, float] = {}
  for name, value, width in zip(chosen.parameters, chosen.as_vector(), widths, strict=True):
    values |= {name: float(value), f"{name}_half_width": float(width)}
  values["held_declared_mrad"] = 1e3 * rmse(held, declared)
  values["held_fitted_mrad"] = 1e3 * rmse(held, chosen)
  harness.finish("mujoco_sysid", {"servo": values}, settings)
  return 0


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
