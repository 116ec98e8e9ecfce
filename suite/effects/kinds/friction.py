"""Friction beyond the nominal model's.

Dry friction of every form goes into MuJoCo's own dof_frictionloss, a constraint solved implicitly:
a joint that sticks stays stuck at any time step, and only its magnitude changes from step to step.
MuJoCo's default constraint is soft: a joint under 90 % of its dry friction creeps (5 mrad/s with
0.05 N m on 0.01 kg m^2). Where an effect adds dry friction, the constraint's impedance is raised,
which divides the creep by 100; `solimpfriction="0.999 0.999"` says the same in MJCF.
"""

import numpy as np

from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Array, Kind, Operator, Parameter
from nerf2real.suite.effects.kinds import laws

_IMPEDANCE = 0.999  # ours, see above
_STRIBECK, _LOAD_FRICTION, _GEAR_LOAD = map(
  laws.over, (laws.stribeck, laws.load_friction, laws.gear_load)
)
_STIFFNESS, _BENT_ON, _PRESLIDING = map(
  laws.over, (laws.contact_stiffness, laws.bent_on, laws.presliding)
)


def _stick(binding: Binding, friction: Array) -> None:
  """Makes the joints [J] with added dry friction stick without creep."""
  dofs = np.arange(binding.model.nv)[binding.dofs][friction > 0]
  binding.model.dof_solimp[dofs, :2] = _IMPEDANCE


class CoulombFriction(Operator):
  """Constant dry friction: magnitude `torque`, against the motion."""

  def bind(self, binding: Binding) -> None:
    torque = self.per_joint(binding)["torque"]
    binding.model.dof_frictionloss[binding.dofs] += torque
    _stick(binding, torque)


class ViscousFriction(Operator):
  """Friction -coefficient * v; integrated implicitly as MuJoCo's own damping is."""

  def bind(self, binding: Binding) -> None:
    binding.model.dof_damping[binding.dofs] += self.per_joint(binding)["coefficient"]


class StribeckFriction(Operator):
  """Dry friction that falls from rest to motion (`laws.stribeck`); Coulomb friction itself is the
  model's or `coulomb_friction`."""

  def bind(self, binding: Binding) -> None:
    parameters = self.per_joint(binding)
    self._breakaway, self._velocity = parameters["breakaway"], parameters["velocity"]
    _stick(binding, self._breakaway)

  def step(self, binding: Binding) -> None:
    binding.friction += _STRIBECK(binding.velocity, self._breakaway, self._velocity)


class LoadFriction(Operator):
  """Dry friction that grows with the torque that the gear transmits (`laws.load_friction`).

  A Stribeck fall is a factor of it: gears under load hold at rest what they pass in motion
  (Duclusaud, Passault, Padois and Ly 2024 measure both on small servos).
  The torque is that of the last step; which one loads the gear is `carried`: 0 the actuators', 1
  that less the joint's damping (back-EMF: what is left is the current's), 2 what the link takes,
  which is also less what the rotor's own inertia needs, 3 the larger of 1 and 2, 4 their mean: a
  gear is loaded from both sides (the same paper's load is the two together).
  """

  def bind(self, binding: Binding) -> None:
    parameters = self.per_joint(binding)
    names = ("coefficient", "quadratic", "rest", "velocity")
    self._law = tuple(parameters[name] for name in names)
    self._carried = parameters["carried"]
    self._damping = binding.model.dof_damping[binding.dofs].copy()
    self._sides = bool((self._carried >= 1).any())
    _stick(binding, parameters["coefficient"] + parameters["quadratic"])

  def step(self, binding: Binding) -> None:
    load = binding.actuator_torque()
    load = self._of_gear(binding, load) if self._sides else np.abs(load)
    binding.friction += _LOAD_FRICTION(load, binding.velocity, *self._law)

  def _of_gear(self, binding: Binding, actuator: Array) -> Array:
    """Returns the torque that loads each gear [J], from the actuators'."""
    data, model, dofs = binding.data, binding.model, binding.dofs
    motor = actuator - self._damping * binding.velocity
    link = data.qfrc_actuator[dofs] + data.qfrc_passive[dofs] + data.qfrc_constraint[dofs]
    link += data.qfrc_applied[dofs] - model.dof_armature[dofs] * data.qacc[dofs]
    return _GEAR_LOAD(self._carried, actuator, motor, link)


class AsymmetricFriction(Operator):
  """Dry friction that differs by direction: `positive` for v > 0, `negative` for v < 0.

  Friction anywhere in [-positive, negative] holds the joint at rest: that is a symmetric dry
  friction of (positive + negative) / 2 and a constant torque of (negative - positive) / 2.
  """

  def bind(self, binding: Binding) -> None:
    parameters = self.per_joint(binding)
    positive, negative = parameters["positive"], parameters["negative"]
    binding.model.dof_frictionloss[binding.dofs] += (positive + negative) / 2
    self._offset = (negative - positive) / 2
    _stick(binding, positive + negative)

  def step(self, binding: Binding) -> None:
    binding.force += self._offset


class Presliding(Operator):
  """Contacts that bend before they slide (`laws.bent_on`): friction is a spring at first, of the
  joint's constant dry friction over `reach`; what friction is larger by at rest or under a load
  bends them further. All dry friction of the joint is theirs and none MuJoCo's constraint's; a
  joint without any is left as it is. Behind play they are on the motor's side, where `backlash`
  bends them.
  """

  def bind(self, binding: Binding) -> None:
    reach = self.per_joint(binding)["reach"]
    self._friction = binding.model.dof_frictionloss[binding.dofs].copy()
    bends = (reach > 0) & (self._friction > 0)
    binding.reach[bends] = reach[bends]
    self._bent, self._was = np.zeros((2, len(reach)))
    self._started = False

  def reset(self) -> None:
    self._bent[:] = 0.0
    self._started = False

  def step(self, binding: Binding) -> None:
    at = np.flatnonzero((binding.reach > 0) & ~binding.geared)
    if not len(at):
      return
    position = binding.position[at]
    if not self._started:
      self._was[at], self._started = position, True
    own, step = self._friction[at], binding.timestep
    dry = own + binding.friction[at]
    stiffness = _STIFFNESS(binding.reach[at], own, binding.inertia()[at], step)
    self._bent[at] = _BENT_ON(self._bent[at], position - self._was[at], stiffness, dry)
    self._was[at] = position
    binding.force[at] -= _PRESLIDING(self._bent[at], binding.velocity[at], stiffness, dry, step)
    binding.friction[at] = -own


class QuadraticDrag(Operator):
  """Drag -coefficient * |v| v; MuJoCo's own polynomial damping, integrated implicitly."""

  def bind(self, binding: Binding) -> None:
    binding.model.dof_dampingpoly[binding.dofs, 0] += self.per_joint(binding)["coefficient"]


KINDS = (
  Kind(
    "coulomb_friction",
    "constant dry friction beyond the declared one",
    "joint",
    "model",
    (Parameter("torque", "N m", 0.0, 0.0, 0.5, "magnitude", minimum=0.0),),
    CoulombFriction,
  ),
  Kind(
    "viscous_friction",
    "friction in proportion to speed beyond the declared one",
    "joint",
    "model",
    (Parameter("coefficient", "N m s/rad", 0.0, 0.0, 2.0, "torque per speed", minimum=0.0),),
    ViscousFriction,
  ),
  Kind(
    "stribeck_friction",
    "dry friction that is larger at rest and falls with speed",
    "joint",
    "force",
    (
      Parameter("breakaway", "N m", 0.0, 0.0, 0.5, "friction at rest minus in motion", minimum=0.0),
      Parameter(
        "velocity", "rad/s", 0.1, 0.01, 1.0, "speed of the fall to 1/e", minimum=0.0, shape=True
      ),
    ),
    StribeckFriction,
  ),
  Kind(
    "load_friction",
    "dry friction that grows with the torque through the gear",
    "joint",
    "force",
    (
      Parameter("coefficient", "1", 0.0, 0.0, 0.4, "friction per torque", minimum=0.0),
      Parameter(
        "quadratic",
        "1/(N m)",
        0.0,
        0.0,
        2.0,
        "friction per squared torque",
        minimum=0.0,
        shape=True,
        fitted=False,
      ),
      Parameter(
        "rest",
        "1",
        0.0,
        0.0,
        1.0,
        "share that it is larger at rest",
        minimum=0.0,
        shape=True,
        fitted=False,
      ),
      Parameter(
        "velocity",
        "rad/s",
        0.1,
        0.01,
        1.0,
        "speed of the fall to 1/e",
        minimum=0.0,
        shape=True,
        fitted=False,
      ),
      Parameter(
        "carried",
        "1",
        0.0,
        0.0,
        4.0,
        "which torque: 0 the actuator's, 1 less damping, 2 the link's, 3 larger, 4 mean of 1 and 2",
        minimum=0.0,
        maximum=4.0,
        shape=True,
        fitted=False,
      ),
    ),
    LoadFriction,
  ),
  Kind(
    "asymmetric_friction",
    "dry friction that differs by direction",
    "joint",
    "force",
    (
      Parameter("positive", "N m", 0.0, 0.0, 0.5, "friction in positive motion", minimum=0.0),
      Parameter("negative", "N m", 0.0, 0.0, 0.5, "friction in negative motion", minimum=0.0),
    ),
    AsymmetricFriction,
  ),
  Kind(
    "quadratic_drag",
    "drag in proportion to the square of speed",
    "joint",
    "model",
    (
      Parameter(
        "coefficient", "N m s^2/rad^2", 0.0, 0.0, 1.0, "torque per squared speed", minimum=0.0
      ),
    ),
    QuadraticDrag,
  ),
  Kind(
    "presliding",
    "contacts that bend before they slide",
    "joint",
    "force",
    (
      Parameter(
        "reach", "rad", 0.0, 0.0, 0.02, "constant dry friction over stiffness", minimum=0.0
      ),
    ),
    Presliding,
  ),
)
