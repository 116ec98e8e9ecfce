"""The gap between the simulation and the virtual robot: the same commands through both.

Two motions of the standing robot: swaying (every joint follows a slow sine of its own) and walking
(the gait's actions of a walk in simulation, without feedback). Every figure is over what a policy
observes, control step by control step: joint positions, turning rates, specific force, direction of
gravity, pictures at 30x40. The simulation is the nominal one, without randomisation; its lens is
the virtual camera's, as a calibration would find it. `picture, same pose` shows the difference of
field and sensor alone: the simulation's picture from where the virtual robot's camera was.

  python benchmarks/robot/gap.py --out benchmarks/results/gap.md
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and mujoco are imported)

import dataclasses
from collections.abc import Callable
from typing import Any

from benchmarks import harness

harness.one_thread()

import cv2
import mujoco
import numpy as np

from nerf2real import real, suite
from nerf2real.core.geometry import rotations
from nerf2real.real.virtual.body import Truth
from nerf2real.real.virtual.camera import LENS, VirtualCamera
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.scenes.quality.image_quality import psnr
from nerf2real.suite.gaits.walk import Command, Gait
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import NOMINAL
from nerf2real.suite.sensors.camera import CameraSettings

_STEP = constants.CONTROL_TIMESTEP
_LEG_SWAY, _ARM_SWAY = 0.05, 0.2  # rad
_OBSERVED = ("joint_positions", "gyroscope", "accelerometer", "gravity")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the comparison."""

  seconds: float = 6.0
  """Length of a motion."""
  robots: tuple[int, ...] = (1, 2, 3)
  """Seeds of the virtual robots; figures are means over them."""
  picture_steps: int = 8
  """Control steps between pictures that are compared; 0: no pictures."""
  start: tuple[float, float, float] = (0.3, -0.6, 2.2)
  """Where the robot starts: x [m], y [m], heading [rad]."""
  seed: int = 0
  """Of the swaying's frequencies."""


class Trace:
  """What was observed, control step by control step."""

  def __init__(self) -> None:
    self.observed: dict[str, list[np.ndarray]] = {name: [] for name in _OBSERVED}
    self.place: list[np.ndarray] = []  # [2] of the torso, by an observer [m]
    self.pictures: dict[int, np.ndarray] = {}  # by step, uint8 [30, 40, 3]
    self.same_pose: dict[int, np.ndarray] = {}  # both, from the virtual camera's pose
    self.fell = False


def sway_actions(count: int, seed: int) -> np.ndarray:
  """Returns actions [T, 20]: sines about the standing pose that grow from nothing."""
  rng = np.random.default_rng(seed)
  lower, upper = constants.joint_limits()
  middle, half = (lower + upper) / 2, (upper - lower) / 2
  standing = (constants.standing_targets() - middle) / half
  upper_body = [
    name.startswith(("head", "l_sho", "r_sho", "l_el", "r_el")) for name in constants.JOINT_NAMES
  ]
  amplitude = np.where(upper_body, _ARM_SWAY, _LEG_SWAY) / half
  frequency, phase = rng.uniform(0.3, 1.2, 20), rng.uniform(0, 2 * np.pi, 20)
  time = _STEP * np.arange(count)[:, None]
  growth = np.minimum(time, 1.0)
  actions = standing + growth * amplitude * np.sin(2 * np.pi * frequency * time + phase)
  return np.clip(actions, -1, 1).astype(np.float32)


def walk_actions(count: int) -> np.ndarray:
  """Returns the gait's actions [T, 20], straight ahead, without feedback."""
  gait = Gait()
  return np.stack([gait.act(Command(1.0)) for _ in range(count)])


def play(
  environment: Any,
  actions: np.ndarray,
  settings: Settings,
  *,
  place: Callable[[], np.ndarray],
  look: Callable[[], np.ndarray] | None = None,
) -> Trace:
  """Plays actions [T, 20]; `place` returns where the torso is, `look` pictures of the same pose."""
  trace = Trace()
  environment.reset()
  for step, action in enumerate(actions):
    timestep = environment.step(action)
    for name, rows in trace.observed.items():
      rows.append(timestep.observation[name][-1])
    trace.place.append(place())
    if settings.picture_steps and step % settings.picture_steps == 0:
      trace.pictures[step] = timestep.observation["camera"].copy()
      if look is not None:
        trace.same_pose[step] = look()
    if timestep.last():
      trace.fell = True
      break
  return trace


class Simulation:
  """The suite's navigation task, started at a place."""

  def __init__(self, settings: Settings):
    size = (30, 40) if settings.picture_steps else None
    self.environment = suite.load(
      "nerf_nav",
      image_size=size,
      random=0,
      randomisation=NOMINAL,
      privileged=False,
      camera=CameraSettings(lens=LENS),
      time_limit=settings.seconds + 1.0,
    )
    x, y, yaw = settings.start
    self.environment.task.set_start(Pose(x, y, yaw))
    self._data = mujoco.MjData(self.environment.physics.model.ptr)

  def run(self, actions: np.ndarray, settings: Settings) -> Trace:
    """Runs actions [T, 20]."""
    task = self.environment.task
    return play(self.environment, actions, settings, place=lambda: task.state.position[:2].copy())

  def picture_at(self, truth: Truth) -> np.ndarray:
    """Returns the simulation's picture of a robot in the virtual robot's true state."""
    task, data = self.environment.task, self._data
    model = self.environment.physics.model.ptr
    free = model.joint(f"{task.robot.mjcf_model.model}/").qposadr[0]
    data.qpos[free : free + 3] = truth.position
    data.qpos[free + 3 : free + 7] = rotations.quaternion_from_matrix(truth.rotation)
    for name, angle in zip(constants.JOINT_NAMES, truth.joints, strict=True):
      data.qpos[model.joint(f"{task.robot.mjcf_model.model}/{name}").qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    return task.robot_camera.render(data)


def run_virtual(
  simulation: Simulation, actions: dict[str, np.ndarray], settings: Settings, *, seed: int
) -> dict[str, Trace]:
  """Runs every motion on a virtual robot in the true room; returns the traces by motion."""
  found = {}
  camera = settings.picture_steps > 0
  eye = VirtualCamera() if camera else None
  with VirtualRobot(world="room", seed=seed, stepped=True, camera=eye) as robot:
    environment = real.load(
      "nerf_nav",
      robot=robot.connection(),
      image_size=(30, 40) if camera else None,
      time_limit=settings.seconds + 1.0,
    )

    def look() -> np.ndarray:
      assert robot.eyes is not None and robot.camera is not None
      now = robot.camera.sensor.develop(robot.eyes.picture())
      small = cv2.resize(now, (40, 30), interpolation=cv2.INTER_AREA)
      return np.stack([small, simulation.picture_at(robot.truth())])

    with environment:
      for name, motion in actions.items():
        robot.place(*settings.start)
        found[name] = play(
          environment, motion, settings, place=lambda: robot.truth().position[:2].copy(), look=look
        )
  return found


def _rms(difference: np.ndarray) -> np.ndarray:
  return np.sqrt(np.mean(difference**2, axis=0))


def compare(simulated: Trace, virtual: Trace) -> dict[str, float]:
  """Returns the figures of one motion on one robot; lengths differ only after a fall."""
  count = min(len(simulated.place), len(virtual.place))
  pairs = {
    name: [np.array(trace.observed[name][:count]) for trace in (simulated, virtual)]
    for name in _OBSERVED
  }
  joints = np.rad2deg(_rms(np.subtract(*pairs["joint_positions"])))
  figures = {
    f"{name} [deg]": float(v) for name, v in zip(constants.JOINT_NAMES, joints, strict=True)
  }
  figures["all joints, mean [deg]"] = float(joints.mean())
  for name, unit in (("gyroscope", "rad/s"), ("accelerometer", "m/s^2")):
    for axis, value in zip("xyz", _rms(np.subtract(*pairs[name])), strict=True):
      figures[f"{name} {axis} [{unit}]"] = float(value)
  lengths = np.prod([np.linalg.norm(gravity, axis=1) for gravity in pairs["gravity"]], axis=0)
  cosine = np.sum(np.multiply(*pairs["gravity"]), axis=1) / lengths
  angle = np.arccos(np.clip(cosine, -1, 1))
  figures["gravity [deg]"] = float(np.rad2deg(np.sqrt(np.mean(angle**2))))
  moved = [trace.place[count - 1] - trace.place[0] for trace in (simulated, virtual)]
  figures["distance travelled, simulation [m]"] = float(np.linalg.norm(moved[0]))
  figures["distance travelled, virtual robot [m]"] = float(np.linalg.norm(moved[1]))
  figures["falls [share of robots]"] = float(virtual.fell)
  steps = sorted(set(simulated.pictures) & set(virtual.pictures))
  if steps:
    as_it_went = [psnr(virtual.pictures[k], simulated.pictures[k]) for k in steps]
    same = [psnr(*pair) for pair in virtual.same_pose.values()]
    figures["picture, as it went [dB PSNR]"] = float(np.mean(as_it_went))
    figures["picture, same pose [dB PSNR]"] = float(np.mean(same))
  return figures


def summary(rows: list[dict[str, float]]) -> dict[str, dict[str, harness.Value]]:
  """Returns, by figure, mean, smallest and largest over the robots."""
  return {
    name: {
      "mean": float(np.mean(values := [row[name] for row in rows])),
      "smallest": min(values),
      "largest": max(values),
    }
    for name in rows[0]
  }


def main(settings: Settings) -> None:
  """Runs the comparison and prints the table."""
  count = round(settings.seconds / _STEP)
  actions = {"sway": sway_actions(count, settings.seed), "walk": walk_actions(count)}
  simulation = Simulation(settings)
  simulated = {name: simulation.run(motion, settings) for name, motion in actions.items()}
  results: dict[str, list[dict[str, float]]] = {name: [] for name in actions}
  for seed in settings.robots:
    virtual = run_virtual(simulation, actions, settings, seed=seed)
    for name, trace in virtual.items():
      results[name].append(compare(simulated[name], trace))
  figures = {
    f"{motion}: {name}": row
    for motion, rows in results.items()
    for name, row in summary(rows).items()
  }
  robots = ", ".join(str(seed) for seed in settings.robots)
  words = (
    f"Simulation against virtual robots {robots}, {settings.seconds:g} s of each motion; RMS over "
    "control steps, over the robots."
  )
  harness.finish("gap", figures, settings, seed=settings.seed, words=words)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
