"""What both tasks share: a robot in a room, its sensors, its action filter and its falls."""

import abc
import collections
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from dm_control import composer
from dm_env import specs

from nerf2real.suite import specs as policy_specs
from nerf2real.suite.arena import SceneArena
from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.suite.effects.drawing import as_gravity, draw_effects
from nerf2real.suite.environment import Reading
from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation import draws as randomising
from nerf2real.suite.sensors import filters
from nerf2real.suite.sensors.camera import RobotCamera
from nerf2real.suite.sensors.proprioception import Proprioception
from nerf2real.suite.tasks import privileged, touch
from nerf2real.suite.tasks.delayed_picture import DelayedPicture
from nerf2real.suite.tasks.settings import TaskSettings
from nerf2real.suite.tasks.state import RobotIndices, RobotState

_MAX_START_ATTEMPTS = 100


class Outcome(NamedTuple):
  """How an episode went, for an evaluation."""

  success: bool
  success_time: float  # s from the start; NaN without success
  ending: str | None  # why it ended early; None: it runs, or reached its time limit
  duration: float  # s


def _single(read: Callable[[], np.ndarray]) -> np.ndarray:
  return np.asarray(read(), np.float32)


class RobotTask(composer.Task):
  """The OP3 in a room. A task defines start, reward and success."""

  weights: Mapping[str, float]  # of the reward terms

  def __init__(
    self,
    scene: Any,
    *,
    camera: RobotCamera | None,
    settings: TaskSettings,
    head_pan_limit: float | None = None,
  ):
    """Builds the model.

    Args:
      scene: A `scenes.bundle.Bundle`, or anything with its collision_parts, extent, goals and
        free_space.
      camera: The robot's camera; None for an environment without pictures.
      settings: Settings of the task.
      head_pan_limit: Limit of the head pan, +- rad; None is the paper's table.
    """
    self.scene = scene
    self.settings = settings
    self.robot_camera = camera
    self._arena = SceneArena(list(scene.collision_parts), scene.extent)
    self._robot = op3.OP3(head_pan_limit=head_pan_limit)
    self._arena.add_free_entity(self._robot)
    self.set_timesteps(constants.CONTROL_TIMESTEP, settings.physics_timestep)
    self._timestep = settings.physics_timestep
    self._substeps = self.physics_steps_per_control_step  # composer computes it at every call
    lower, upper = self._robot.control_limits
    self._middle, self._half_range = (lower + upper) / 2, (upper - lower) / 2
    paper_lower, paper_upper = constants.joint_limits()
    self._joint_range = paper_upper - paper_lower
    self._standing = (constants.standing_targets() - self._middle) / self._half_range
    self._action_filter = filters.ExponentialFilter(constants.ACTION_FILTER)
    self._proprioception = Proprioception(
      physics_timestep=settings.physics_timestep, substeps=self._substeps
    )
    self.start: Pose | None = None  # if set, every episode starts here (evaluation, rehearsal)
    self.hand_force = np.zeros(3)  # N on the torso in the world, in addition to the pushes
    self.draws: randomising.EpisodeDraws | None = None
    self.reward_terms: dict[str, float] = {}
    self.success = False
    self.success_time = float("nan")  # s
    self.ending: str | None = None  # why the episode ended, None while it runs
    self._observables: collections.OrderedDict[str, Reading] | None = None

  @property
  def root_entity(self) -> composer.Arena:
    return self._arena

  @property
  def robot(self) -> op3.OP3:
    """The robot."""
    return self._robot

  @property
  def state(self) -> RobotState:
    """The robot's true state."""
    return self._state

  @property
  def render_time(self) -> float:
    """Time spent on pictures since the environment was built [s]."""
    return 0.0 if self._picture is None else self._picture.render_time

  @property
  def standing_action(self) -> np.ndarray:
    """The action [20] that holds the reference pose (clipped to the limits)."""
    return self._standing.astype(np.float32)

  # ---- what a task defines ----

  @abc.abstractmethod
  def _place(self, random_state: np.random.RandomState) -> None:
    """Writes qpos of everything for a new episode."""

  @abc.abstractmethod
  def _goal_observation(self) -> np.ndarray:
    """Returns the goal as the policy sees it [2]."""

  @abc.abstractmethod
  def _goal_position(self) -> np.ndarray:
    """Returns the goal in the world [2] [m]."""

  @abc.abstractmethod
  def _compute_rewards(self) -> dict[str, float]:
    """Returns the reward terms and their weighted `total`."""

  @abc.abstractmethod
  def _reached(self) -> bool:
    """Returns whether the goal of the task is met now."""

  @abc.abstractmethod
  def _failure(self) -> str | None:
    """Returns why the episode must end, or None."""

  def _ball_geom(self) -> str | None:
    """Returns the name of the ball's geom, if there is a ball."""
    return None

  def _privileged(self) -> dict[str, privileged.Quantity]:
    """Returns further privileged observations by name."""
    return {}

  # ---- composer's life cycle ----

  def after_compile(self, physics: Any, random_state: np.random.RandomState) -> None:
    self._model, self._data = physics.model.ptr, physics.data.ptr
    model = self._model
    self._indices = RobotIndices(physics, self._robot)
    self._touch = touch.Touch(model, root=self._indices.root, feet=self._indices.feet)
    self._effects = self._bind_effects(self.settings.effects)
    self._randomiser = self._make_randomiser()
    self._picture: DelayedPicture | None = None
    if self.robot_camera is not None:
      self.robot_camera.bind(model, int(physics.bind(self._robot.camera).element_id))
      self._picture = DelayedPicture(
        model,
        self.robot_camera,
        randomisation=self.settings.randomisation,
        timestep=self._timestep,
        substeps=self._substeps,
      )
    self._substep = 0

  def _make_randomiser(self) -> randomising.Randomiser:
    """Returns the randomiser of the model as it is now, with its constant effects."""
    return randomising.Randomiser(
      self._model,
      torso=self._robot.torso.full_identifier,
      ball=self._ball_geom(),
      imu_sites=(self._robot.imu.full_identifier,),
    )

  def _bind_effects(self, declared: Sequence[Effect]) -> EffectStack:
    """Writes the constant effects into the model; the others act at every step and reading."""
    prefix = f"{self._robot.mjcf_model.model}/"
    robot_names = {*constants.JOINT_NAMES, *self._robot.bodies}
    effects = [
      dataclasses.replace(effect, target=prefix + effect.target)
      if effect.target in robot_names
      else as_gravity(effect)
      for effect in declared
    ]
    if self.robot_camera is not None:  # a longer lens shows more detail: rendered, not magnified
      scales = [e.parameters.get("scale", 1.0) for e in effects if e.kind == "camera_focal"]
      self.robot_camera.set_focal_scale(float(np.prod(scales)))
      effects = [effect for effect in effects if effect.kind != "camera_focal"]
    joints = [prefix + name for name in constants.JOINT_NAMES]
    stack = EffectStack(effects).bind(self._model, joints=joints)
    self._proprioception.observe = stack.observe if effects else None
    self._effects_act = not stack.is_constant
    return stack

  def _redraw_effects(self, random_state: np.random.RandomState) -> None:
    """Puts effects with other values of their intervals into the model."""
    self._randomiser.restore()
    self._effects.unbind()
    self._effects = self._bind_effects(draw_effects(self.settings.effects, random_state))
    self._randomiser = self._make_randomiser()

  def initialize_episode(self, physics: Any, random_state: np.random.RandomState) -> None:
    self.draws = randomising.draw_episode(
      self.settings.randomisation, random_state, time_limit=self.settings.time_limit
    )
    if self.settings.draw_effects and self.settings.effects:
      self._redraw_effects(random_state)
    self._randomiser.apply(self.draws)
    if self.robot_camera is not None:
      self.robot_camera.set_light(self.draws.light)
    self._control = self._standing.copy()
    self._action_filter.reset(self._control)
    self._targets = self._middle + self._half_range * self._control
    self._effects.reset(self._targets)
    self._place(random_state)
    physics.set_control(self._targets)
    self._touch.reset()
    self.success, self.success_time, self.ending = False, float("nan"), None

  def start_sensors(self, physics: Any, random_state: np.random.RandomState) -> None:
    """Fills the sensor path with the state at the start of an episode."""
    if self.draws is None:  # the environment is being built
      return
    mujoco.mj_forward(self._model, self._data)
    self._random_state = random_state
    self._proprioception.reset(
      self._data.sensordata[self._indices.imu],
      self._data.qpos[self._indices.joint_qpos],
      self._control,
      imu_delay=self.draws.imu_delay,
      joint_delay=self.draws.joint_delay,
      jitter=self.draws.jitter,
      rng=np.random.default_rng(random_state.randint(2**31)),
    )
    if self._picture is not None:
      self._picture.reset(self._data.qpos, random_state)
    self._state = self._indices.read()

  def before_step(
    self, physics: Any, action: np.ndarray, random_state: np.random.RandomState
  ) -> None:
    self._control = self._action_filter(np.clip(action, -1.0, 1.0))
    self._targets = self._middle + self._half_range * self._control
    self._data.ctrl[:] = self._targets
    assert self.draws is not None
    self._data.xfrc_applied[self._indices.torso, :3] = (
      self.draws.pushes.at(self._data.time) + self.hand_force
    )
    self._substep = 0

  def before_substep(
    self, physics: Any, action: np.ndarray, random_state: np.random.RandomState
  ) -> None:
    if self._effects_act:
      self._effects.before_step(self._data, self._targets)

  def after_substep(self, physics: Any, random_state: np.random.RandomState) -> None:
    data = self._data
    qpos = data.qpos
    self._proprioception.record(
      self._substep, data.sensordata[self._indices.imu], qpos[self._indices.joint_qpos]
    )
    if self._picture is not None:
      self._picture.record(qpos)
    self._touch.note(data)
    self._substep += 1

  def after_step(self, physics: Any, random_state: np.random.RandomState) -> None:
    self._proprioception.finish_step(self._control)
    self._state = self._indices.read()
    self.reward_terms = self._compute_rewards()
    self.ending = self._failure()
    if self.ending is None and not self.success and self._reached():
      self.success, self.success_time = True, float(self._data.time)

  def get_reward(self, physics: Any) -> float:
    return self.reward_terms["total"]

  def should_terminate_episode(self, physics: Any) -> bool:
    return self.ending is not None

  def get_discount(self, physics: Any) -> float:
    return 0.0 if self.ending is not None else 1.0

  def action_spec(self, physics: Any) -> specs.BoundedArray:
    return policy_specs.action_spec()

  # ---- state and termination ----

  @property
  def outcome(self) -> Outcome:
    """How the episode has gone so far."""
    return Outcome(self.success, self.success_time, self.ending, float(self._data.time))

  @property
  def touches_scene(self) -> bool:
    """Whether a part other than the feet has touched the room in this episode."""
    return self._touch.scene

  @property
  def fallen(self) -> bool:
    """Whether the robot has fallen: tilted, low, or on the floor with anything but its feet."""
    return (
      self._state.rotation[2, 2] < constants.MIN_UPRIGHT
      or self._state.position[2] < constants.MIN_HEIGHT
      or self._touch.floor
    )

  def _stand_somewhere(self, draw: Callable[[], Pose]) -> None:
    """Stands the robot at `start`, or at a drawn place where it touches nothing but the floor."""
    if self.start is not None:
      self._indices.stand_at(self.start)
      return
    for _ in range(_MAX_START_ATTEMPTS):
      self._indices.stand_at(draw())
      touch.collide(self._model, self._data)
      if not self._touch.now(self._data):
        return
    raise composer.EpisodeInitializationError(
      f"Found no start pose free of contact in {_MAX_START_ATTEMPTS} attempts: the free space of "
      f"the scene {getattr(self.scene, 'name', '')!r} does not fit its collision parts."
    )

  def relative(self, xy: np.ndarray) -> np.ndarray:
    """Returns a point of the floor [2] relative to the robot, gravity-aligned frame [2] [m]."""
    return self._state.relative(xy)

  # ---- observations ----

  @property
  def observables(self) -> collections.OrderedDict[str, Reading]:
    """The policy's observations, then those of the critic alone."""
    if self._observables is None:
      self._observables = self._make_observables()
    return self._observables

  def _make_observables(self) -> collections.OrderedDict[str, Reading]:
    readings: collections.OrderedDict[str, Reading] = collections.OrderedDict()
    lower, upper = self._arena.extent
    camera = self.robot_camera
    policy = policy_specs.policy_observation_spec(
      goal_lower=lower, goal_upper=upper, image_shape=None if camera is None else camera.shape
    )
    for name, spec in policy.items():
      if name == "goal":
        readings[name] = Reading(lambda: self._goal_observation().astype(np.float32), spec)
      elif name == "camera":
        readings[name] = Reading(self._take_picture, spec)
      else:
        readings[name] = Reading(functools.partial(self._proprioception.histories.read, name), spec)
    if self.settings.privileged:
      known = privileged.of_robot(
        lambda: self._state, goal=self._goal_position, draws=lambda: self.draws
      )
      for name, quantity in {**known, **self._privileged()}.items():
        readings[privileged.PREFIX + name] = Reading(
          functools.partial(_single, quantity.read), specs.Array((quantity.size,), np.float32)
        )
    return readings

  def picture_of(
    self, *, position: np.ndarray, rotation: np.ndarray, joints: np.ndarray
  ) -> np.ndarray:
    """Returns the picture uint8 [H, W, 3] of a robot in another state, all else being as it is.

    Args:
      position: Of the torso [3] [m].
      rotation: World from torso [3, 3].
      joints: [20] rad.
    """
    assert self._picture is not None
    qpos = self._data.qpos.copy()
    self._indices.write(qpos, position=position, rotation=rotation, joints=joints)
    return self._picture.of(qpos)

  def _take_picture(self) -> np.ndarray:
    """Returns the picture that has arrived by now."""
    assert self.draws is not None and self._picture is not None
    picture = self._picture.take(
      self.draws.camera_delay, jitter=self.draws.jitter, random_state=self._random_state
    )
    return self._effects.observe("camera", picture, float(self._data.time))
