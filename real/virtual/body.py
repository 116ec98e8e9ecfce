"""The virtual robot's body in its world: a MuJoCo plant that is not the training simulation's.

The link table is shared with `suite` (both describe an OP3); everything that acts is its own:
voltage driven motors with load-dependent gear friction instead of position actuators, other
armature, contact and friction, a step of 1 ms, a battery, the true room instead of its
reconstruction, and whatever `Hidden` holds. A hand can hold the torso, as a person does at start
and end.
"""

import threading
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from nerf2real.core.geometry import rotations
from nerf2real.real.virtual.hidden import Hidden, Load
from nerf2real.real.virtual.motors import Motors
from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.pose import Pose
from nerf2real.suite.sensors import filters
from nerf2real.suite.sensors.delays import History

STEP = 0.001  # s
WORLDS = ("floor", "room")
PREFIX = "op3/"
_STOP_MARGIN = 0.5  # rad from the control limits to a joint's mechanical stop: chosen
_HELD_HEIGHT = 0.30  # m of the torso: legs hang free
_HAND_SPEED = 0.1  # m/s
_LET_GO_LAG = 0.002  # m that the torso stays above the sinking hand when the feet carry it
_LOWEST_HAND = 0.2  # m
_TRACE_PERIOD, _TRACE_LENGTH = 0.005, 128  # s, poses kept for delayed pictures
_BALL_MASS, _BALL_RADIUS = 0.651, 0.12  # kg, m: the real ball, paper
_ORANGE = (0.85, 0.40, 0.10, 1.0)
_TOUCH_NORMAL = 0.7  # a contact whose normal is steeper than this, near z = 0, is with the floor
_FLOOR_HEIGHT = 0.02  # m


class Truth(NamedTuple):
  """Measurements of an observer in the room."""

  time: float  # s
  position: np.ndarray  # torso [3] in the world [m]
  rotation: np.ndarray  # world from torso [3, 3]
  velocity: np.ndarray  # torso [3] in the world [m/s]
  joints: np.ndarray  # [20] rad
  touches_room: bool  # a part other than the feet has touched the room since `place`
  touches_floor: bool  # a part other than the feet has touched the floor since `place`
  held: bool  # by a hand
  ball: np.ndarray | None  # centre of the ball [3] [m], if there is one

  @property
  def yaw(self) -> float:
    """Heading [rad]."""
    return rotations.yaw_of(self.rotation)

  @property
  def pose(self) -> Pose:
    """Place and heading on the floor."""
    return Pose.of(self.position, self.yaw)


class Body:
  """The plant: call `advance`, set motor goals, read sensors; threads may call it."""

  def __init__(
    self,
    *,
    world: str = "floor",
    hidden: Hidden | None = None,
    ball: bool = False,
    furnish: Callable[[mujoco.MjSpec], None] | None = None,
    looks: bool = True,
  ):
    """Builds the world and hangs the robot at its origin.

    Args:
      world: "floor", or "room" for the built-in room (its looks take 10 s to paint).
      hidden: The robot's own physics; as in the data sheets if None.
      ball: Whether there is a ball.
      furnish: Called with the world's `mujoco.MjSpec` before the robot is put in, to change it.
      looks: Whether the room can be seen.
    """
    if world not in WORLDS:
      raise ValueError(f"Unknown world {world!r}: expected one of {WORLDS}.")
    self.hidden = hidden or Hidden.none(len(constants.JOINT_NAMES))
    self.model = _build(world, self.hidden, ball, furnish, looks)
    self.data = mujoco.MjData(self.model)
    self.motors = Motors(self.hidden.motors)
    self.lock = threading.RLock()
    self.push = np.zeros(3)  # N on the torso in the world, until it is changed
    self.after_step: Callable[[float], None] | None = None  # called with the time [s]
    model = self.model
    joints = [model.joint(PREFIX + name) for name in constants.JOINT_NAMES]
    self._qpos = np.array([joint.qposadr[0] for joint in joints])
    self._dofs = np.array([joint.dofadr[0] for joint in joints])
    self._torso = model.body(PREFIX + constants.TORSO_LINK).id
    self._root = int(model.jnt_qposadr[model.body_jntadr[self._torso]])
    self._root_dof = int(model.jnt_dofadr[model.body_jntadr[self._torso]])
    self._hand, self._weld = model.body("hand").mocapid[0], model.equality("hand").id
    first = model.sensor(PREFIX + "gyroscope").adr[0]
    self._imu_slice = slice(first, first + 6)
    # Views: every access to a field of MjData makes a new array.
    self._force, self._friction = self.data.qfrc_applied, model.dof_frictionloss
    self._positions, self._velocities = self.data.qpos, self.data.qvel
    self._sensors = self.data.sensordata[self._imu_slice]
    self._low_pass = filters.LowPass(filters.CHIP_BANDWIDTH_HZ, 1 / STEP)
    self.imu = np.zeros(6)  # what the chip gives: rad/s [3], m/s^2 [3]
    self._bias = np.array([*self.hidden.gyroscope_bias, *self.hidden.accelerometer_bias])
    self._parts = self._other_parts()
    self._ball = int(model.joint("ball").qposadr[0]) if ball else None
    self._trace = History(_TRACE_LENGTH)  # poses
    self._lowering = False
    self.time = 0.0  # s; follows the clock of whoever calls `advance`
    self.place(0.0, 0.0, 0.0)

  def place(self, x: float, y: float, yaw: float) -> None:
    """Hangs the robot, legs in the air, over a place [m] with a heading [rad]."""
    with self.lock:
      data, root = self.data, self._root
      data.qpos[root : root + 3] = (x, y, _HELD_HEIGHT)
      data.qpos[root + 3 : root + 7] = rotations.yaw_quaternion(yaw)
      data.qpos[self._qpos] = constants.standing_targets()
      data.qvel[:] = 0.0
      self.hold(True)
      data.mocap_pos[self._hand] = data.qpos[root : root + 3]
      data.mocap_quat[self._hand] = data.qpos[root + 3 : root + 7]
      self._touches = [False, False]
      mujoco.mj_forward(self.model, data)
      self._low_pass.reset()
      self._sense()

  def place_ball(self, x: float, y: float) -> None:
    """Puts the ball on the floor at a place [m]."""
    if self._ball is None:
      raise ValueError("This world has no ball: make the robot with ball=True.")
    with self.lock:
      self.data.qpos[self._ball : self._ball + 3] = (x, y, _BALL_RADIUS)
      dof = int(self.model.joint("ball").dofadr[0])
      self.data.qvel[dof : dof + 6] = 0.0

  def hold(self, held: bool) -> None:
    """Takes the robot by its torso and lifts it, or lowers it to its feet and lets go."""
    with self.lock:
      data = self.data
      if held:
        if not data.eq_active[self._weld]:
          data.mocap_pos[self._hand] = data.qpos[self._root : self._root + 3]
          yaw = self.truth().yaw
          data.mocap_quat[self._hand] = rotations.yaw_quaternion(yaw)
        data.eq_active[self._weld] = 1
      self._lowering = not held

  def turn(self, yaw: float) -> None:
    """Turns the hand that holds the robot to a heading [rad]."""
    with self.lock:
      self.data.mocap_quat[self._hand] = rotations.yaw_quaternion(yaw)

  def advance(self, time: float) -> None:
    """Simulates up to a time [s]."""
    with self.lock:
      while self.time + STEP <= time + 1e-9:
        self._step()

  def skip(self, time: float) -> None:
    """Stands still until a time [s], if that has not come yet: what was missed is not made up."""
    with self.lock:
      self.time = max(self.time, time)

  def _step(self) -> None:
    model, data = self.model, self.data
    torque, friction = self.motors.torque(self.time, STEP)
    self._force[self._dofs] = torque
    self._friction[self._dofs] = friction
    data.xfrc_applied[self._torso, :3] = self.push
    if data.eq_active[self._weld]:
      self._move_hand()
    mujoco.mj_step(model, data)
    self.time += STEP
    self._sense()
    if self.after_step is not None:
      self.after_step(self.time)
    if self.time >= self._trace.last_time + _TRACE_PERIOD:
      self._trace.push(self.time, data.qpos)
      if data.ncon:
        self._note_touches()

  def _sense(self) -> None:
    self.motors.measure(self._positions[self._qpos], self._velocities[self._dofs])
    self.imu = self._low_pass(self._sensors + self._bias)

  def _move_hand(self) -> None:
    position = self.data.mocap_pos[self._hand]
    if self._lowering:
      position[2] -= _HAND_SPEED * STEP
      lag = self.data.qpos[self._root + 2] - position[2]
      if lag > _LET_GO_LAG or position[2] < _LOWEST_HAND:
        self.data.eq_active[self._weld] = 0
    elif position[2] < _HELD_HEIGHT:
      position[2] += _HAND_SPEED * STEP

  def _other_parts(self) -> np.ndarray:
    """Returns which geoms are the robot's and not its feet's [G]."""
    model = self.model
    feet = [model.body(PREFIX + name).id for name in constants.FOOT_LINKS]
    robot = model.body_rootid[model.geom_bodyid] == model.body_rootid[self._torso]
    return robot & ~np.isin(model.geom_bodyid, feet)

  def _note_touches(self) -> None:
    if self._touches[0] and self._touches[1]:
      return
    contact = self.data.contact
    geoms = contact.geom
    static = self.model.body_weldid[self.model.geom_bodyid[geoms]] == 0
    hits = (self._parts[geoms[:, 0]] & static[:, 1]) | (self._parts[geoms[:, 1]] & static[:, 0])
    if hits.any():
      upright = np.abs(contact.frame[hits, 2]) > _TOUCH_NORMAL
      floor = upright & (contact.pos[hits, 2] < _FLOOR_HEIGHT)
      self._touches[0] |= bool((~floor).any())
      self._touches[1] |= bool(floor.any())

  def truth(self) -> Truth:
    """Returns the measurements of an observer in the room."""
    with self.lock:
      data = self.data
      return Truth(
        time=self.time,
        position=data.qpos[self._root : self._root + 3].copy(),
        rotation=rotations.matrix_from_quaternion(data.qpos[self._root + 3 : self._root + 7]),
        velocity=data.qvel[self._root_dof : self._root_dof + 3].copy(),
        joints=data.qpos[self._qpos].copy(),
        touches_room=self._touches[0],
        touches_floor=self._touches[1],
        held=bool(data.eq_active[self._weld]),
        ball=None if self._ball is None else data.qpos[self._ball : self._ball + 3].copy(),
      )

  def pose_at(self, time: float) -> np.ndarray:
    """Returns qpos at the newest kept moment not after a time [s] (up to 0.6 s ago)."""
    with self.lock:
      return self._trace.newest(time) if self._trace.count else self.data.qpos.copy()


def _build(world: str, hidden: Hidden, ball: bool, furnish, looks: bool) -> mujoco.MjModel:
  """Returns the compiled world with the robot in it."""
  if world == "room":
    from nerf2real.scenes.builtin import room

    spec = room.build_room(looks=looks)
  else:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
      name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], group=3
    )
    spec.visual.quality.shadowsize = spec.visual.quality.offsamples = 0
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 2560, 2048
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 12.0
    spec.stat.extent = 1.0
  if furnish is not None:
    furnish(spec)
  spec.option.timestep = STEP
  spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
  level = rotations.matrix_from_rotvec([*hidden.floor_slope, 0.0])
  spec.option.gravity = level.T @ spec.option.gravity
  for geom in spec.geoms:
    geom.solref[0] = hidden.contact_time
  spec.attach(_robot(hidden), prefix=PREFIX, frame=spec.worldbody.add_frame())
  hand = spec.worldbody.add_body(name="hand", mocap=True, pos=[0, 0, _HELD_HEIGHT])
  spec.add_equality(
    name="hand",
    type=mujoco.mjtEq.mjEQ_WELD,
    objtype=mujoco.mjtObj.mjOBJ_BODY,
    name1=hand.name,
    name2=PREFIX + constants.TORSO_LINK,
    # anchor 0, relative pose identity, torque scale 1
    data=[0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0],
    active=True,
  )
  if ball:
    body = spec.worldbody.add_body(name="ball", pos=[0, 0, 5.0])
    body.add_freejoint(name="ball")
    body.add_geom(
      name="ball",
      type=mujoco.mjtGeom.mjGEOM_SPHERE,
      size=[_BALL_RADIUS, 0, 0],
      mass=_BALL_MASS,
      rgba=_ORANGE,
      group=0,
      condim=6,
      friction=[0.6, 0.01, 0.002],
    )
  return spec.compile()


def _robot(hidden: Hidden) -> mujoco.MjSpec:
  """Returns the robot without actuators, with its own friction, contact and mass."""
  spec = mujoco.MjSpec.from_string(op3.OP3().mjcf_model.to_xml_string())
  for actuator in list(spec.actuators):
    spec.delete(actuator)
  lower, upper = constants.joint_limits(head_pan=constants.BALL_PUSHING_HEAD_PAN)
  stops = dict(zip(constants.JOINT_NAMES, zip(lower, upper, strict=True), strict=True))
  for joint in spec.joints:
    joint.damping[0] = hidden.bearing_damping
    joint.armature = hidden.armature
    low, high = stops[joint.name]
    joint.limited, joint.range = True, [low - _STOP_MARGIN, high + _STOP_MARGIN]
  torso = spec.body(constants.TORSO_LINK)
  torso.add_freejoint(name="root")
  loads = [Load(constants.TORSO_LINK, hidden.payload, hidden.payload_position), *hidden.loads]
  for index, load in enumerate(loads):
    if load.mass > 0:
      spec.body(load.link).add_body(name=f"load_{index}", pos=list(load.position)).add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[0.01, 0, 0],
        mass=load.mass,
        group=4,
        contype=0,
        conaffinity=0,
      )
  for name in constants.FOOT_LINKS:
    for geom in spec.body(name).geoms:
      geom.friction[0] = hidden.foot_friction
      geom.priority = 1  # the foot's friction counts, not the larger of the two
      geom.solref[0] = hidden.contact_time
  spec.site("imu").quat = rotations.quaternion_from_rotvec(hidden.imu_tilt)
  return spec
