"""Chooses the physics step: how far open-loop motion at a step is from motion at a very fine one.

The same robot stands on the same floor and follows the same random targets (through the action
filter) for half a second, as it would between two corrections of a policy. Its end state is
compared with the end state at 0.125 ms. As a truth the last rows show what a change of mass
within the paper's randomisation (0 to 0.5 kg) does to the same motion at the fine step: an error
far below it cannot matter to a policy. The results are in suite/README.md.

  python benchmarks/simulation/physics_step.py
"""

import dataclasses
from typing import Any

import mujoco
import numpy as np
from dm_control import composer, mjcf

from benchmarks import harness
from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.randomisation import inertia
from nerf2real.suite.sensors import filters
from nerf2real.suite.tasks.state import standing_posture

REFERENCE = 0.000125  # s
STEPS = (0.00625, 0.005, 0.0025, 0.00125, 0.0005)  # s, each divides the control step
INTEGRATORS = {
  "Euler": mujoco.mjtIntegrator.mjINT_EULER,
  "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the study."""

  episodes: int = 24
  """Random motions."""
  control_steps: int = 20
  """Length of a motion [25 ms]."""


def make_physics() -> Any:
  """Returns the robot on a plane."""
  arena = composer.Arena()
  arena.mjcf_model.worldbody.add("geom", type="plane", size=(5, 5, 0.1))
  arena.add_free_entity(op3.OP3())
  return mjcf.Physics.from_mjcf_model(arena.mjcf_model)


def targets(seed: int, count: int) -> np.ndarray:
  """Returns smoothed random position targets [count, 20]."""
  rng = np.random.default_rng(seed)
  lower, upper = constants.joint_limits()
  smooth = filters.ExponentialFilter(constants.ACTION_FILTER)
  smooth.reset(constants.standing_targets())
  return np.array([smooth(rng.uniform(lower, upper)) for _ in range(count)])


def simulate(
  model: mujoco.MjModel, commands: np.ndarray, *, step: float, integrator: int
) -> np.ndarray:
  """Returns the state [joints 20, torso position 3, up axis 3, angular velocity 3] at the end."""
  model.opt.timestep, model.opt.integrator = step, integrator
  data = mujoco.MjData(model)
  joints = [model.joint(f"op3/{name}").qposadr[0] for name in constants.JOINT_NAMES]
  posture = standing_posture()
  data.qpos[:7], data.qpos[joints] = posture[:7], posture[7:]
  for command in commands:
    data.ctrl[:] = command
    mujoco.mj_step(model, data, round(constants.CONTROL_TIMESTEP / step))
  mujoco.mj_forward(model, data)
  torso = model.body("op3/body_link").id
  up = data.xmat[torso].reshape(3, 3)[2]
  return np.concatenate([data.qpos[joints], data.xpos[torso], up, data.qvel[3:6]])


def differences(states: np.ndarray, reference: np.ndarray) -> np.ndarray:
  """Returns joint RMS [deg], torso position [mm], tilt [deg] and turning rate [deg/s], each [N]."""
  error = states - reference
  joints = np.rad2deg(np.sqrt(np.mean(error[:, :20] ** 2, axis=1)))
  position = 1e3 * np.linalg.norm(error[:, 20:23], axis=1)
  cosine = np.sum(states[:, 23:26] * reference[:, 23:26], axis=1)
  tilt = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
  rate = np.rad2deg(np.linalg.norm(error[:, 26:], axis=1))
  return np.stack([joints, position, tilt, rate])


def figures_of(errors: np.ndarray) -> dict[str, harness.Value]:
  """Returns medians and 90th percentiles of differences [4, N]."""
  names = ("joints_{}_degrees", "torso_{}_mm", "tilt_{}_degrees", "turning_rate_{}_degrees_per_s")
  return {
    name.format(word): float(np.percentile(row, share))
    for name, row in zip(names, errors, strict=True)
    for word, share in (("median", 50), ("p90", 90))
  }


def main(settings: Settings) -> None:
  """Runs the study."""
  model = make_physics().model.ptr
  commands = [targets(seed, settings.control_steps) for seed in range(settings.episodes)]

  def run(step: float, integrator: int) -> tuple[np.ndarray, float]:
    states: list[np.ndarray] = []

    def motion(index: int) -> None:
      states.append(simulate(model, commands[index], step=step, integrator=integrator))

    times = harness.interleave({"motion": motion}, rounds=settings.episodes, warm_up=0)["motion"]
    return np.array(states), times.figures(per=settings.control_steps)["median_ms"]

  reference, _ = run(REFERENCE, INTEGRATORS["Euler"])
  figures: dict[str, dict[str, harness.Value]] = {}
  for name, integrator in INTEGRATORS.items():
    for step in STEPS:
      states, cost = run(step, integrator)
      row = {**figures_of(differences(states, reference)), "control_step_ms": cost}
      figures[f"{name}_{1e3 * step:g}_ms"] = row
  torso = model.body("op3/body_link").id
  for added in (0.05, 0.25):
    snapshot = inertia.Snapshot(model)
    inertia.attach_mass(model, torso, added=added, position=(0.0, 0.0, 0.06))
    inertia.refresh(model, mujoco.MjData(model))
    states, _ = run(REFERENCE, INTEGRATORS["Euler"])
    snapshot.restore(model)
    figures[f"torso_heavier_{1e3 * added:g}_g"] = figures_of(differences(states, reference))
  harness.finish("physics_step", figures, settings, seed=f"0 to {settings.episodes - 1}")


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
