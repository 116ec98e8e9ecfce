"""The training simulation as a plant: nominal physics, the radiance field as its picture."""

import dataclasses
from typing import Any

import dm_env
import numpy as np

from nerf2real import suite
from nerf2real.evaluation.plants import perturbations, swaps
from nerf2real.evaluation.plants.plant import TASKS, Plant, Sight, Trial, make_intruder
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.suite import protocols
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.sensors.camera import CameraSettings
from nerf2real.suite.tasks import nerf_nav


class SimulatedPlant(Plant):
  """Episodes in the suite. No pushes: nobody pushes the robot in an evaluation."""

  name = "sim"

  def __init__(
    self,
    scene: Any,
    settings: EvaluationSettings,
    *,
    image_size: tuple[int, int] | None,
    camera: CameraSettings | None = None,
    draw_effects: bool = False,
  ):
    """Builds the environment.

    Args:
      scene: An opened bundle.
      settings: The evaluation's; read are protocol, perturbation, effects, seed, time limit, swap.
      image_size: Height and width of the picture; None for no camera.
      camera: Settings of the camera; the suite's own if None.
      draw_effects: Whether every episode draws the effects' values from their intervals.
    """
    super().__init__(scene, settings)
    seed, swap = settings.seed, settings.swap
    self.plant_id = f"seed {seed}"
    self._room = swaps.TrueRoom(scene) if swaps.PICTURE in swap and image_size else None
    self._seed = seed
    self._intruder = make_intruder(self, protocols.scene_starts(scene))
    self._environment = suite.load(
      TASKS[self.protocol],
      scene=scene,
      effects=settings.effects,
      draw_effects=draw_effects,
      image_size=image_size,
      camera=swaps.camera_in_simulation(camera or CameraSettings(), swap),
      renderer=self._room,
      random=seed,
      randomisation=dataclasses.replace(RandomisationSettings(), pushes=False),
      time_limit=settings.time_limit,
      furnish=None if self._intruder is None else self._intruder.add_to_arena,
    )
    if self._intruder is not None:
      self._intruder.bind(self._environment.physics.model.ptr)

  @property
  def environment(self) -> dm_env.Environment:
    return self._environment

  @property
  def task(self) -> Any:
    """The suite's task."""
    return self._environment.task

  @property
  def goal(self) -> np.ndarray:
    task = self.task
    return task.goal if self.protocol != "ball" else np.asarray(task.workspace.target)

  @property
  def time_limit(self) -> float:
    return float(self.task.settings.time_limit)

  def start(self, trial: Trial) -> dm_env.TimeStep:
    self._environment.random_state.seed([self._seed, trial.seed])
    self.task.set_trial(trial)
    self._hit = False
    timestep = self._environment.reset()
    return self._disturb(timestep)

  def step(self, action: np.ndarray) -> dm_env.TimeStep:
    if self._intruder is not None:
      data = self._environment.physics.data.ptr
      self._intruder.move(data, float(data.time))
    timestep = self._environment.step(action)
    if self._intruder is not None:
      self._hit |= self._intruder.touched(self._environment.physics.data.ptr)
    return self._disturb(timestep)

  def _disturb(self, timestep: dm_env.TimeStep) -> dm_env.TimeStep:
    time = float(self._environment.physics.data.time)
    if "camera" in timestep.observation and perturbations.is_blocked(self.perturbation, time):
      dark = np.zeros_like(timestep.observation["camera"])
      return timestep._replace(observation={**timestep.observation, "camera": dark})
    return timestep

  def sight(self) -> Sight:
    task = self.task
    ball = task.ball_position[:2] if self.protocol == "ball" else None
    collided = task.ending == nerf_nav.COLLISION or self._hit
    return Sight(task.state.pose, ball, collided, task.ending == nerf_nav.FALL)

  def close(self) -> None:
    self._environment.close()
    if self._room is not None:
      self._room.close()
