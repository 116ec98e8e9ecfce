"""The virtual robot as a plant: reached over its wires, placed and watched as by an observer."""

import contextlib
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import dm_env
import numpy as np

from nerf2real import real
from nerf2real.evaluation.plants import perturbations, swaps
from nerf2real.evaluation.plants.plant import TASKS, Sight, Trial, make_intruder
from nerf2real.evaluation.plants.robot_plant import RobotPlant
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.virtual import undeclared
from nerf2real.real.virtual.camera import LENS
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.real.virtual.undeclared import Undeclared
from nerf2real.suite.op3.constants import MIN_HEIGHT, MIN_UPRIGHT
from nerf2real.suite.pose import Pose
from nerf2real.suite.protocols import BALL, NavigationTrial
from nerf2real.suite.sensors.camera import CameraSettings


def put_down(pose: Pose, trial: Trial, errors: tuple[float, float]) -> Pose:
  """Returns where a person puts the robot: for a repetition of a navigation trial, beside its pose.

  Args:
    pose: Of the trial.
    trial: Its seed draws the errors, so that all robots and conditions have the same.
    errors: Largest errors of place [m, each axis] and heading [rad]; uniform within.
  """
  if not isinstance(trial, NavigationTrial) or trial.trial == 0:
    return pose
  drawn = np.random.default_rng([trial.seed, trial.trial]).uniform(-1.0, 1.0, 3)
  place, heading = errors
  x, y, yaw = np.array(pose) + drawn * (place, place, heading)
  return Pose(float(x), float(y), float(yaw))


class CoveredCamera:
  """A camera that can be covered: the paper's blocked camera."""

  def __init__(self, camera: Any):
    self._camera = camera
    self.covered = False

  def read(self) -> tuple[np.ndarray, float]:
    """Returns the newest picture and its age [s]; black while covered."""
    picture, age = self._camera.read()
    return (np.zeros_like(picture) if self.covered else picture), age

  def close(self) -> None:
    """Closes the camera."""
    self._camera.close()


class RehearsedPlant(RobotPlant):
  """Episodes on a virtual robot in the true room, faster than real time."""

  name = "virtual"

  def __init__(
    self,
    scene: Any,
    settings: EvaluationSettings,
    *,
    image_size: tuple[int, int] | None,
    simulated: CameraSettings | None = None,
    altered: Sequence[Undeclared] = (),
    session: float = 0.0,
    world: str = "room",
    record: Path | None = None,
  ):
    """Builds the robot and connects to it.

    Args:
      scene: An opened bundle of the room that the robot stands in.
      settings: The evaluation's; read are protocol, perturbation, time limit, placing, the first
        robot's seed, and what of it is swapped for the simulation's.
      image_size: Height and width of the policy's picture; None for no camera.
      simulated: The simulation's camera, for what is swapped; the suite's own if None.
      altered: Undeclared effects that the robot has besides.
      session: Time that its battery was in use before [s].
      world: "room" or "floor", see `VirtualRobot`.
      record: Where the run is recorded; not recorded if None.
    """
    super().__init__(scene, settings, record=record)
    robot_seed = settings.robot_seed[0]
    self.plant_id = f"robot {robot_seed}"
    self._placing = settings.placing
    self._camera: CoveredCamera | None = None
    with contextlib.ExitStack() as undone:  # unless all succeeds
      undone.callback(self._abandon_recording)
      self._intruder = make_intruder(self, self._starts)
      if altered:
        self.plant_id += ", altered"
      known = swaps.PHYSICS in settings.swap
      build = undeclared.build(None if known else robot_seed, altered, age=session)
      simulated = simulated or CameraSettings()
      camera = swaps.camera_on_the_robot(build.camera, simulated, settings.swap)
      view = None
      if image_size is not None and swaps.PICTURE in settings.swap:
        view = swaps.field_view(scene, image_size, camera.lens)
      self.robot = VirtualRobot(
        world=world,
        seed=robot_seed,
        hidden=build.hidden,
        stepped=True,
        camera=None if image_size is None else camera,
        ball=self.protocol == BALL,
        furnish=None if self._intruder is None else self._intruder.add_to_spec,
        view=view,
      )
      undone.callback(self.robot.close)
      if self._intruder is not None:
        self._intruder.bind(self.robot.body.model)
      self._environment = self._connect(image_size, settings.time_limit)
      undone.pop_all()

  def _connect(self, image_size: tuple[int, int] | None, time_limit: float | None) -> Any:
    connection = self.robot.connection()
    if image_size is not None:
      self._camera = CoveredCamera(connection.camera)
      connection = dataclasses.replace(connection, camera=self._camera)
      if self._recorder is not None:
        self._recorder.camera_info(self.robot.clock.wall(self.robot.clock.now()), LENS)
    return real.load(
      TASKS[self.protocol],
      robot=connection,
      scene=self.scene,
      image_size=image_size,
      time_limit=time_limit,
      recorder=self._recorder,
    )

  def start(self, trial: Trial) -> dm_env.TimeStep:
    self._begin = self.robot.clock.now()
    self._hit = False
    self._disturb(0.0)
    pose, ball = self._places(trial)
    pose = put_down(pose, trial, self._placing)
    if ball is not None:
      self.robot.place_ball(*ball)
    if isinstance(trial, NavigationTrial) and self.robot.camera is not None:
      self.robot.camera.sensor.gain = trial.camera_gain
    self.robot.place(*pose)
    timestep = self._environment.reset()
    self._begin = self.robot.clock.now()
    return timestep

  def step(self, action: np.ndarray) -> dm_env.TimeStep:
    self._disturb(self.robot.clock.now() - self._begin)
    timestep = self._environment.step(action)
    if self._intruder is not None:
      self._hit |= self._intruder.touched(self.robot.body.data)
    return timestep

  def _disturb(self, time: float) -> None:
    if self._camera is not None:
      self._camera.covered = perturbations.is_blocked(self.perturbation, time)
    if self._intruder is not None:
      with self.robot.body.lock:
        self._intruder.move(self.robot.body.data, time)

  def sight(self) -> Sight:
    truth = self.robot.truth()
    fallen = (
      truth.touches_floor
      or truth.rotation[2, 2] < MIN_UPRIGHT
      or truth.position[2] < MIN_HEIGHT
      or self._stopped_by_a_fall()
    )
    ball = None if truth.ball is None else truth.ball[:2]
    # Touching the room is a failure of navigation alone (paper, "Tasks").
    touched = truth.touches_room and self.protocol != BALL
    return Sight(truth.pose, ball, touched or self._hit, bool(fallen))

  def close(self) -> None:
    with contextlib.ExitStack() as endings:  # from the last one to the first
      if self._recorder is not None:
        endings.callback(self._recorder.close)
      endings.callback(self.robot.close)
      endings.callback(self._environment.close)
