"""What both tasks share: a robot in a room, its sensors, its action filter and its falls."""

import abc
import collections
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from dm_control import composer, mjcf
from dm_env import specs

from suite import filters, rewards
from suite import randomisation as randomising
from suite import specs as policy_specs
from suite.arena import SceneArena
from suite.camera import RobotCamera
from suite.effects import Effect, EffectStack
from suite.environment import Reading
from suite.op3 import constants, op3
from suite.proprioception import Proprioception

PHYSICS_TIMESTEP = 0.0025  # s: benchmarks/physics_step.py, results in suite/README.md
MIN_UPRIGHT = 0.5  # cosine of the torso's tilt below which it has fallen (60 degrees): ours
MIN_HEIGHT = 0.14  # m of the torso's origin above the floor (standing: 0.246): ours
_MAX_START_ATTEMPTS = 100
_TOUCHES_SCENE, _TOUCHES_FLOOR = 1, 2  # bits of what a part other than the feet touches


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskSettings:
  """Settings of a task."""

  time_limit: float  # s
  physics_timestep: float = PHYSICS_TIMESTEP  # s; the control step is a multiple of it
  privileged: bool = True  # whether to give the observations that only the critic may see
  effects: Sequence[Effect] = ()  # what the nominal model lacks; targets with or without "op3/"
  randomisation: randomising.RandomisationSettings = dataclasses.field(
    default_factory=randomising.RandomisationSettings
  )

  def __post_init__(self):
    if not self.time_limit > 0:
      raise ValueError(f"The time_limit must be positive [s], found {self.time_limit}.")
    steps = constants.CONTROL_TIMESTEP / self.physics_timestep if self.physics_timestep > 0 else 0
    if not (steps >= 1 and abs(steps - round(steps)) < 1e-6):
      raise ValueError(
        f"The physics_timestep must divide the control step of {constants.CONTROL_TIMESTEP} s, "
        f"found {self.physics_timestep}."
      )


class RobotState(NamedTuple):
  """The robot's true state at the end of a control step."""

  position: np.ndarray  # torso [3] in the world [m]
  rotation: np.ndarray  # world from torso [3, 3]
  aligned: np.ndarray  # world from gravity-aligned frame [3, 3] (suite.rewards)
  velocity: np.ndarray  # torso [3] in the world [m/s]
  angular_velocity: np.ndarray  # torso [3] in the world [rad/s]
  feet_velocity: np.ndarray  # midpoint of the feet [3], gravity-aligned frame [m/s]
  yaw_speed: float  # of the gravity-aligned frame [rad/s]
  joints: np.ndarray  # [20] rad
  joint_velocities: np.ndarray  # [20] rad/s

  @property
  def yaw(self) -> float:
    """Heading in the world [rad]."""
    return float(np.arctan2(self.aligned[1, 0], self.aligned[0, 0]))


class Start(NamedTuple):
  """Where the robot stands at the start of an episode."""

  xy: tuple[float, float]  # m
  yaw: float  # rad


class Outcome(NamedTuple):
  """How an episode went, for an evaluation."""

  success: bool
  success_time: float  # s from the start; NaN without success
  ending: str | None  # why it ended early; None: it runs, or reached its time limit
  duration: float  # s


@functools.cache
def standing_posture() -> np.ndarray:
  """Returns qpos [27] of the robot standing at rest at the origin on a flat floor, facing +x.

  The servos are soft: under its weight the robot settles a little away from what they are told.
  """
  arena = composer.Arena()
  robot = op3.OP3()
  arena.mjcf_model.worldbody.add("geom", type="plane", size=(2, 2, 0.1))
  arena.add_free_entity(robot)
  arena.mjcf_model.option.timestep = PHYSICS_TIMESTEP
  physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
  targets = constants.standing_targets()
  joints = physics.bind(robot.joints)
  with physics.reset_context():
    physics.data.qpos[2] = 0.26
    joints.qpos = targets
    physics.set_control(targets)
  physics.step(round(2.0 / PHYSICS_TIMESTEP))
  qpos = np.concatenate([physics.data.qpos[:7], joints.qpos])
  qpos[:2] = 0.0
  qpos.setflags(write=False)
  return qpos


def _single(read: Callable[[], np.ndarray]) -> np.ndarray:
  return np.asarray(read(), np.float32)


class RobotTask(composer.Task):
  """The OP3 in a room. A task says where it starts, what is rewarded and when it has succeeded."""

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
      physics_timestep=settings.physics_timestep,
      substeps=self._substeps,
    )
    self.start: Start | None = None  # if set, every episode starts here (evaluation, rehearsal)
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

  def _privileged(self) -> dict[str, tuple[int, Any]]:
    """Returns further privileged observations: name to (size, function)."""
    return {}

  # ---- composer's life cycle ----

  def after_compile(self, physics: Any, random_state: np.random.RandomState) -> None:
    self._model, self._data = physics.model.ptr, physics.data.ptr
    model = self._model
    joints = physics.bind(self._robot.joints).element_id
    self._joint_qpos = np.asarray(model.jnt_qposadr[joints])
    self._joint_dofs = np.asarray(model.jnt_dofadr[joints])
    self._torso = int(physics.bind(self._robot.torso).element_id)
    root = model.body_rootid[self._torso]
    free = model.body_jntadr[root]
    self._root_qpos, self._root_dof = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
    self._feet = [int(physics.bind(foot).element_id) for foot in self._robot.feet]
    gyroscope = physics.bind(self._robot.mjcf_model.find("sensor", "gyroscope")).element_id
    first = int(model.sensor_adr[gyroscope])
    self._imu_slice = slice(first, first + 6)  # the accelerometer follows the gyroscope
    self._touch_table = self._make_touch_table(root)
    self._effects = self._bind_effects()
    self._randomiser = randomising.Randomiser(
      model, torso=self._robot.torso.full_identifier, ball=self._ball_geom(),
      imu_sites=(self._robot.imu.full_identifier,),
    )  # fmt: skip
    self._past = mujoco.MjData(model)  # the state that a delayed picture shows
    if self.robot_camera is not None:
      self.robot_camera.bind(model, int(physics.bind(self._robot.camera).element_id))
      latency = self.robot_camera.settings.latency
    else:
      latency = 0.0
    draws = self.settings.randomisation
    oldest = latency + draws.delay_range[1] + draws.jitter_half_width
    rows = int(np.ceil(oldest / self._timestep)) + self._substeps + 1
    self._qpos_trace = np.zeros((rows, model.nq))  # newest last
    self._camera_latency = latency
    self._substep = 0

  def _bind_effects(self) -> EffectStack:
    """Writes the constant effects into the model; the others act at every step and reading."""
    prefix = f"{self._robot.mjcf_model.model}/"
    robot_names = {*constants.JOINT_NAMES, *self._robot.bodies}
    effects = [
      dataclasses.replace(effect, target=prefix + effect.target)
      if effect.target in robot_names
      else effect
      for effect in self.settings.effects
    ]
    joints = [prefix + name for name in constants.JOINT_NAMES]
    stack = EffectStack(effects).bind(self._model, joints=joints)
    self._proprioception.observe = stack.observe if effects else None
    self._effects_act = not stack.is_constant
    return stack

  def _make_touch_table(self, root: int) -> np.ndarray:
    """Returns uint8 [geoms, geoms]: what a robot part other than a foot touches in a contact."""
    model = self._model
    robot = (model.body_rootid[model.geom_bodyid] == root) & ~np.isin(model.geom_bodyid, self._feet)
    static = model.body_weldid[model.geom_bodyid] == 0
    bits = np.where(model.geom_group == op3.FLOOR_GROUP, _TOUCHES_FLOOR, _TOUCHES_SCENE)
    one_way = np.outer(robot, static * bits)
    return (one_way | one_way.T).astype(np.uint8)

  def initialize_episode(self, physics: Any, random_state: np.random.RandomState) -> None:
    self.draws = randomising.draw_episode(
      self.settings.randomisation, random_state, time_limit=self.settings.time_limit
    )
    self._randomiser.apply(self.draws)
    self._effects.reset()
    self._place(random_state)
    self._control = self._standing.copy()
    self._action_filter.reset(self._control)
    self._targets = self._middle + self._half_range * self._control
    physics.set_control(self._targets)
    self._touched = 0
    self.success, self.success_time, self.ending = False, float("nan"), None

  def start_sensors(self, physics: Any, random_state: np.random.RandomState) -> None:
    """Fills the sensor path with the state at the start of an episode."""
    if self.draws is None:  # the environment is being built
      return
    mujoco.mj_forward(self._model, self._data)
    self._random_state = random_state
    self._proprioception.reset(
      self._data.sensordata[self._imu_slice], self._data.qpos[self._joint_qpos], self._control,
      imu_delay=self.draws.imu_delay, joint_delay=self.draws.joint_delay,
      jitter=self.draws.jitter, rng=np.random.default_rng(random_state.randint(2**31)),
    )  # fmt: skip
    self._qpos_trace[:] = self._data.qpos
    self._update_state()

  def before_step(
    self, physics: Any, action: np.ndarray, random_state: np.random.RandomState
  ) -> None:
    self._control = self._action_filter(np.clip(action, -1.0, 1.0))
    self._targets = self._middle + self._half_range * self._control
    self._data.ctrl[:] = self._targets
    assert self.draws is not None
    self._data.xfrc_applied[self._torso, :3] = (
      self.draws.pushes.at(self._data.time) + self.hand_force
    )
    self._substep = 0
    count = self._substeps
    self._qpos_trace[:-count] = self._qpos_trace[count:]

  def before_substep(
    self, physics: Any, action: np.ndarray, random_state: np.random.RandomState
  ) -> None:
    if self._effects_act:
      self._effects.before_step(self._data, self._targets)

  def after_substep(self, physics: Any, random_state: np.random.RandomState) -> None:
    data = self._data
    qpos = data.qpos
    self._proprioception.record(
      self._substep, data.sensordata[self._imu_slice], qpos[self._joint_qpos]
    )
    self._substep += 1
    self._qpos_trace[self._substep - 1 - self._substeps] = qpos
    if data.ncon:
      pairs = data.contact.geom
      self._touched |= int(np.bitwise_or.reduce(self._touch_table[pairs[:, 0], pairs[:, 1]]))

  def after_step(self, physics: Any, random_state: np.random.RandomState) -> None:
    self._proprioception.finish_step(self._control)
    self._update_state()
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
    return bool(self._touched & _TOUCHES_SCENE)

  @property
  def fallen(self) -> bool:
    """Whether the robot has fallen: tilted, low, or on the floor with anything but its feet."""
    return (
      self._state.rotation[2, 2] < MIN_UPRIGHT
      or self._state.position[2] < MIN_HEIGHT
      or bool(self._touched & _TOUCHES_FLOOR)
    )

  def _update_state(self) -> None:
    model, data = self._model, self._data
    rotation = data.xmat[self._torso].reshape(3, 3).copy()
    aligned = rewards.gravity_aligned_frame(rotation, model.opt.gravity)
    dof = self._root_dof
    angular = rotation @ data.qvel[dof + 3 : dof + 6]
    twist, feet = np.empty(6), np.zeros(3)
    for foot in self._feet:
      mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, foot, twist, 0)
      feet += twist[3:] / 2
    self._state = RobotState(
      position=data.xpos[self._torso].copy(),
      rotation=rotation,
      aligned=aligned,
      velocity=data.qvel[dof : dof + 3].copy(),
      angular_velocity=angular,
      feet_velocity=feet @ aligned,
      yaw_speed=rewards.yaw_rate(rotation, angular, model.opt.gravity),
      joints=data.qpos[self._joint_qpos],
      joint_velocities=data.qvel[self._joint_dofs],
    )

  def _stand_at(self, start: Start) -> None:
    """Writes the standing posture at a place."""
    posture = standing_posture()
    qpos, root = self._data.qpos, self._root_qpos
    qpos[root : root + 2] = start.xy
    qpos[root + 2] = posture[2]
    turn = np.array([np.cos(start.yaw / 2), 0, 0, np.sin(start.yaw / 2)])
    mujoco.mju_mulQuat(qpos[root + 3 : root + 7], turn, posture[3:7])
    qpos[self._joint_qpos] = posture[7:]

  def _stand_somewhere(self, draw: Callable[[], Start]) -> None:
    """Stands the robot at `start`, or at a drawn place where it touches nothing but the floor."""
    if self.start is not None:
      self._stand_at(self.start)
      return
    for _ in range(_MAX_START_ATTEMPTS):
      self._stand_at(draw())
      if not self._touches_anything():
        return
    raise composer.EpisodeInitializationError(
      f"Found no start pose free of contact in {_MAX_START_ATTEMPTS} attempts: the free space of "
      f"the scene {getattr(self.scene, 'name', '')!r} does not fit its collision parts."
    )

  def _touches_anything(self) -> bool:
    mujoco.mj_kinematics(self._model, self._data)
    mujoco.mj_comPos(self._model, self._data)
    mujoco.mj_collision(self._model, self._data)
    pairs = self._data.contact.geom
    return bool(self._touch_table[pairs[:, 0], pairs[:, 1]].any())

  def relative(self, xy: np.ndarray) -> np.ndarray:
    """Returns a point of the floor [2] relative to the robot, gravity-aligned frame [2] [m]."""
    offset = np.array([xy[0], xy[1], 0.0]) - self._state.position
    offset[2] = 0.0
    return (offset @ self._state.aligned)[:2]

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
        readings[name] = Reading(functools.partial(self._proprioception.read, name), spec)
    if self.settings.privileged:
      for name, (size, read) in self._all_privileged().items():
        readings[f"privileged/{name}"] = Reading(
          functools.partial(_single, read), specs.Array((size,), np.float32)
        )
    return readings

  def _all_privileged(self) -> dict[str, tuple[int, Any]]:
    return {
      "robot_position": (3, lambda: self._state.position),
      "robot_rotation": (9, lambda: self._state.rotation.ravel()),
      "robot_velocity": (3, lambda: self._state.velocity @ self._state.aligned),
      "robot_angular_velocity": (3, lambda: self._state.angular_velocity @ self._state.aligned),
      "joint_positions": (20, lambda: self._state.joints),
      "joint_velocities": (20, lambda: self._state.joint_velocities),
      "goal": (2, lambda: self.relative(self._goal_position())),
      "randomisation": (
        randomising.NUM_DRAWS,
        lambda: np.zeros(randomising.NUM_DRAWS) if self.draws is None else self.draws.vector(),
      ),
      **self._privileged(),
    }

  def _take_picture(self) -> np.ndarray:
    """Returns the picture that has arrived by now: it shows the world a little earlier."""
    assert self.draws is not None and self.robot_camera is not None
    delay = self._camera_latency + self.draws.camera_delay
    if self.draws.jitter:
      delay = max(0.0, delay + self._random_state.uniform(-1, 1) * self.draws.jitter)
    age = min(round(delay / self._timestep), len(self._qpos_trace) - 1)
    self._past.qpos[:] = self._qpos_trace[-1 - age]
    mujoco.mj_kinematics(self._model, self._past)
    mujoco.mj_camlight(self._model, self._past)
    picture = self.robot_camera.render(self._past, self._random_state)
    return self._effects.observe("camera", picture, float(self._data.time))
