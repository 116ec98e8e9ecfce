"""One joint of a MuJoCo model at a time: its surroundings as functions of time.

The other joints are prescribed: they move as they were measured. What remains for joint j is

    (I(t) + armature) dv/dt + g(t, q) + c(t) = actuator, friction, spring

with I = M_jj, gravity's torque g (a sine and cosine of a hinge's position, constant for a slide)
and c, what the other joints' velocities and accelerations demand. All of it is linear in the masses
and in gravity, so payloads and tilts are added as linear combinations without another pass.

Geared servos carry most of their inertia in their own rotors, which is why one joint at a time is a
good approximation; the figures of a report are simulated by the whole model. Where links weigh as
much, a joint feels the others' accelerations at every jump of a command: their motion is taken in
detail (`motion.py`), and the model is evaluated where a line between two places would miss that.

Shapes: N samples of a log, J joints of the log, T points of the simulation's grid, M of them, the
knots, at which the model is evaluated.
"""

import dataclasses
import functools

import mujoco
import numpy as np
from scipy.stats import norm

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model import chains, point_mass
from nerf2real.sysid.model.drive import actuator_of, holds_position
from nerf2real.sysid.model.motion import Motion, detailed_motion, smooth_motion
from nerf2real.sysid.model.simulation import simulate

Array = np.ndarray

LONGEST_STEP = 5e-3
"""s; chosen: a model with a longer step than this is simulated in parts of it."""

_SPACING = 0.03  # s between poses at which a model is evaluated; chosen
_MISSED = 0.05  # of an acceleration's standard deviation that a line between knots may miss; chosen
_SHIFT = 0.1  # rad (or m) by which a zero is shifted to see what that changes; chosen: a large one
_REACH = 0.1  # m of the places at which a mass is put to see its moments
_UNIT = _REACH * np.eye(3)
_MONOMIALS_AT = np.array(
  [np.zeros(3), *_UNIT, *(-_UNIT), _UNIT[0] + _UNIT[1], _UNIT[0] + _UNIT[2], _UNIT[1] + _UNIT[2]]
)
_MONOMIALS = np.array(
  [[1, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z] for x, y, z in _MONOMIALS_AT]
)


@dataclasses.dataclass(frozen=True)
class Surroundings:
  """What a joint feels of its model, on the grid of a log's simulation [T]."""

  inertia: Array
  """Without armature, kg m^2."""
  here: Array
  """Gravity's torque at `at`, to be overcome, N m."""
  across: Array
  """The same a quarter turn further; 0 for a slide."""
  at: Array
  """The joint's measured position, rad."""
  bias: Array
  """What the others' motion demands, N m."""


class Reduction:
  """Computes the surroundings of joints of a model along a log."""

  def __init__(
    self,
    model: mujoco.MjModel,
    log: Log,
    *,
    motion: Motion | None = None,
    knots: Array | None = None,
  ):
    """Prepares the poses.

    Args:
      model: compiled model; not changed for longer than a call.
      log: its joints are prescribed; joints that it lacks stay at the model's reference pose.
      motion: of its joints on the grid, if other than this model tells in detail.
      knots: of that motion [M], where they are known.
    """
    self.model, self.log = model, log
    own = float(model.opt.timestep)
    self.step = own / np.ceil(own / LONGEST_STEP)
    self.time = np.arange(0.0, log.states.stamp[-1] + 0.05, self.step)
    self.motion = smooth_motion(log)
    self._alone = len(log.joints) == 1 and model.nv == 1
    if self._alone:
      self.detailed, self._knots = self.motion.at(self.time), np.zeros(1, int)
    else:
      self.detailed = detailed_motion(model, log, self.time) if motion is None else motion
      spacing = round(_SPACING / self.step)
      self._knots = _knots(self.detailed.acceleration, spacing) if knots is None else knots
    ids = [model.joint(name).id for name in log.joints]
    self._qpos = model.jnt_qposadr[ids]
    self._dofs = model.jnt_dofadr[ids]
    self._poses: point_mass.Poses | None = None
    self._moments: dict[int, dict[str, Array]] = {}
    self._reread: dict[str, dict[str, Array]] = {}

  @functools.cached_property
  def twin(self) -> tuple["Reduction", Array] | None:
    """The declared machine's own recording under the same commands, reduced, and its positions
    without the readings' noise [N, J]: what joints one by one miss there is the reduction's error.

    None of one joint, and where the machine does not hold positions: its course would be another.
    """
    model, log = self.model, self.log
    actuators = [actuator_of(model, name) for name in log.commands.joints]
    if self._alone or not all(holds_position(model, u) for u in actuators):
      return None
    measured = log.states.position
    assert measured is not None
    course = simulate(model, log)
    scatter = np.median(np.abs(measured - self.motion.position), axis=0) / norm.ppf(0.75)
    read = course + scatter * np.random.default_rng(0).standard_normal(course.shape)
    states = dataclasses.replace(log.states, position=read)
    return Reduction(model, dataclasses.replace(log, states=states)), course

  def of_joint(self, joint: str) -> Surroundings:
    """Returns what a joint feels of the model, not lifted by firmware: see `compensation`."""
    return self._on_grid(joint, *self._at_knots(joint))

  def compensation(self, joint: str) -> Surroundings | None:
    """Returns what firmware lifts of a joint's gravity (`gravcomp`), None where it lifts nothing.

    It knows the declared weights where the encoders read them to be, and no others.
    """
    if not self._lifted.any():
      return None
    none = np.zeros(len(self._knots))
    here, across = self._weights(joint, self._lifted) @ self.model.opt.gravity
    return self._on_grid(joint, none, here, across, none)

  def gravity(self, joint: str) -> list[Surroundings]:
    """Returns what gravity adds to a joint's surroundings per m/s^2 along the world's x, y, z."""
    none = np.zeros(len(self._knots))
    parts = np.moveaxis(self._weights(joint), -1, 0)
    return [self._on_grid(joint, none, here, across, none) for here, across in parts]

  def zero(self, joint: str, shifted: str) -> list[Surroundings]:
    """Returns what an offset of a joint's readings adds to a joint's surroundings.

    The machine is not where they say. Per rad (or m), and per square of it; gravity's torque on a
    joint at its own angle is known of each angle, so that its own offset adds none.
    """
    if shifted not in self._reread:
      self._reread[shifted] = self._zeros(shifted)
    fields = self._reread[shifted].get(joint, np.zeros((2, 4, len(self._knots))))
    return [self._on_grid(joint, *part) for part in fields]

  def _zeros(self, shifted: str) -> dict[str, Array]:
    """Returns `zero` at the knots [2, 4, M] for all joints of a joint's chain."""
    ahead, back = self._shifted(shifted, _SHIFT), self._shifted(shifted, -_SHIFT)
    result = {}
    for joint in set(chains.along(self.model, shifted)).intersection(self.log.joints):
      here = self._at_knots(joint)
      more, less = ahead._at_knots(joint) - here, back._at_knots(joint) - here
      fields = np.array([(more - less) / (2 * _SHIFT), (more + less) / (2 * _SHIFT**2)])
      if joint == shifted:
        fields[:, 1:3] = 0.0
      result[joint] = fields
    return result

  def _shifted(self, joint: str, offset: float) -> "Reduction":
    """Returns the same motion where a joint's readings lack an offset."""
    position = self.detailed.position.copy()
    position[:, self.log.states.column(joint)] -= offset
    motion = dataclasses.replace(self.detailed, position=position)
    return Reduction(self.model, self.log, motion=motion, knots=self._knots)

  def _at_knots(self, joint: str) -> Array:
    """Returns what a joint feels at the knots [4, M]: inertia, gravity's torque, that a quarter
    turn further, and bias."""
    dof = int(self.model.jnt_dofadr[self.model.joint(joint).id])
    inertia, bias, _ = self._evaluated
    here, across = self._weights(joint) @ self.model.opt.gravity
    return np.array([inertia[:, dof], here, across, bias[:, dof]])

  @functools.cached_property
  def _evaluated(self) -> tuple[Array, Array, Array]:
    """The model at the knots.

    Inertia without armature and what the others' motion demands [M, nv]; the centres of
    mass of the bodies, then axes and anchors of the joints [M, bodies + 2 joints, 3].
    """
    model, data, motion = self.model, mujoco.MjData(self.model), self.detailed
    count, still = len(self._knots), np.zeros(model.nv)
    diagonal = model.M_rowadr + model.M_rownnz - 1
    inertia, bias, demanded = np.zeros((3, count, model.nv))
    places = np.zeros((count, model.nbody + 2 * model.njnt, 3))
    ends = model.nbody, model.nbody + model.njnt
    acceleration = np.zeros((count, model.nv))
    acceleration[:, self._dofs] = 0.0 if self._alone else motion.acceleration[self._knots]
    data.qpos[:] = model.qpos0
    data.qpos[self._qpos] = 0.0
    for n, knot in enumerate(self._knots):
      if not self._alone:
        data.qpos[self._qpos] = motion.position[knot]
      mujoco.mj_kinematics(model, data)
      mujoco.mj_comPos(model, data)
      mujoco.mj_makeM(model, data)
      inertia[n] = data.M[diagonal]
      places[n, : ends[0]] = data.xipos
      places[n, ends[0] : ends[1]] = data.xaxis
      places[n, ends[1] :] = data.xanchor
      if self._alone:
        continue
      data.qvel[:] = 0.0
      mujoco.mj_comVel(model, data)
      mujoco.mj_rne(model, data, 0, still)
      data.qvel[self._dofs] = motion.velocity[knot]
      mujoco.mj_comVel(model, data)
      mujoco.mj_rne(model, data, 0, bias[n])
      mujoco.mj_mulM(model, data, demanded[n], acceleration[n])
      bias[n] -= still
    bias += demanded - inertia * acceleration
    return inertia - model.dof_armature, bias, places

  @property
  def _lifted(self) -> Array:
    """Mass of every body that firmware lifts [bodies], kg."""
    return self.model.body_mass * self.model.body_gravcomp

  def _weights(self, joint: str, masses: Array | None = None) -> Array:
    """Returns gravity's torque, and a quarter turn further, at the knots per m/s^2 [2, M, 3].

    Args:
      joint: that carries them.
      masses: of the bodies, the model's if left out; the joint feels those that it carries.
    """
    model, places = self.model, self._evaluated[2]
    index = model.joint(joint).id
    body = int(model.jnt_bodyid[index])
    axis, anchor = places[:, model.nbody + index], places[:, model.nbody + model.njnt + index]
    carried = chains.carried(model, body)
    masses = (model.body_mass if masses is None else masses)[carried]
    if not self._hinge(joint):
      return -masses.sum() * np.array([axis, np.zeros_like(axis)])
    moment = np.einsum("b,mbc->mc", masses, places[:, carried] - anchor[:, None])
    moved = np.cross(axis, moment)
    return -np.array([moved, np.cross(axis, moved)])

  def _hinge(self, joint: str) -> bool:
    kind = int(self.model.jnt_type[self.model.joint(joint).id])
    return kind == int(mujoco.mjtJoint.mjJNT_HINGE)

  def _on_grid(
    self, joint: str, inertia: Array, here: Array, across: Array, bias: Array
  ) -> Surroundings:
    """Returns surroundings on the grid from those at the knots [M].

    Gravity is interpolated as a vector that turns with a hinge.
    """
    at = self.detailed.position[:, self.log.states.column(joint)] * (not self._alone)
    if self._hinge(joint):
      cos, sin = np.cos(at), np.sin(at)
      c, s = cos[self._knots], sin[self._knots]
      x, y = self._between(here * c - across * s), self._between(here * s + across * c)
      here, across = x * cos + y * sin, y * cos - x * sin
    else:
      here, across = self._between(here), self._between(across)
    return Surroundings(self._between(inertia), here, across, at, self._between(bias))

  def _between(self, values: Array) -> Array:
    return np.interp(np.arange(len(self.time)), self._knots, values)

  def moments(self, joint: str, body: int) -> list[Surroundings]:
    """Returns what mass and its moments on a body add, per unit.

    In the order 1, x, y, z, xx, yy, zz, xy, xz, yz: each is what a joint's surroundings gain per
    unit of mass times that monomial of its place in the body's frame.
    """
    if body not in self._moments:
      self._moments[body] = self._moments_of(body)
    fields = self._moments[body].get(joint, np.zeros((len(_MONOMIALS), 4, len(self._knots))))
    return [self._on_grid(joint, *part) for part in fields]

  def _moments_of(self, body: int) -> dict[str, Array]:
    """Returns the moments [10, 4, M] at the knots for all joints that carry a body."""
    model, motion = self.model, self.detailed
    positions = motion.position[self._knots] * (not self._alone)
    if self._poses is None:
      self._poses = point_mass.Poses(model, self._qpos, positions)
    carrying = chains.carrying(model, body)
    names = [model.joint(k).name for k in carrying]
    velocity, acceleration = np.zeros((2, len(self._knots), len(carrying)))
    for i, name in enumerate(names):
      if name in self.log.joints and not self._alone:
        column = self.log.states.column(name)
        velocity[:, i] = motion.velocity[self._knots, column]
        acceleration[:, i] = motion.acceleration[self._knots, column]
    values = []
    for place in _MONOMIALS_AT:
      point = self._poses.point(body, place)
      values.append(point_mass.added(self._poses, carrying, point, velocity, acceleration))
    solved = np.linalg.solve(_MONOMIALS, np.array(values).reshape(len(_MONOMIALS), -1))
    solved = solved.reshape(len(_MONOMIALS), len(carrying), 4, len(self._knots))
    return {name: solved[:, i] for i, name in enumerate(names) if name in self.log.joints}


def _knots(acceleration: Array, spacing: int) -> Array:
  """Returns points [M] between which the joints' accelerations [T, J] are nearly straight.

  Args:
    acceleration: on the grid.
    spacing: points between two knots at most.
  """
  points = np.arange(len(acceleration))
  knots = np.append(points[:-1:spacing], points[-1])
  allowed = _MISSED * acceleration.std(axis=0) + 1e-12
  while True:
    line = np.array([np.interp(points, knots, a[knots]) for a in acceleration.T]).T
    missed = np.flatnonzero((np.abs(acceleration - line) > allowed).any(axis=1))
    if not len(missed):
      return knots
    after = np.unique(np.searchsorted(knots, missed))
    knots = np.union1d(knots, (knots[after - 1] + knots[after]) // 2)
