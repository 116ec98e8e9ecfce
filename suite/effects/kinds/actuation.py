"""What happens between the command and the torque: latency, strength, limits, heat, supply.

Strength is written into the actuators' gain and bias constants, so that MuJoCo's implicit
integration, its force limits and its actuator_force all see the weakened actuator.
"""

import math

import numpy as np

from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Array, Kind, Operator, Parameter
from nerf2real.suite.effects.kinds import laws
from nerf2real.suite.sensors.delays import StepRing

_WARMED, _STRENGTH_OF_HEAT = map(laws.over, (laws.warmed, laws.strength_of_heat))


class _Torque:
  """Torques of the last step at the joints that actuators drive, and what back-EMF takes of them.

  A motor's torque at a duty falls with its speed by its back-EMF, which servos' models have in the
  joint's damping: the torque less that is the current's.
  """

  def __init__(self, binding: Binding):
    """Notes gear and damping, which must have been written by then."""
    self._gear, self._joint = binding.gear, binding.actuator_joint
    damping = binding.model.dof_damping[binding.dofs]
    self._damping = np.append(damping, 0.0)[self._joint]  # of joint -1 none

  def at_joints(self, binding: Binding) -> Array:
    """Returns the actuators' torques [U] N m."""
    return binding.last_force * self._gear

  def of_back_emf(self, binding: Binding) -> Array:
    """Returns damping times speed [U] N m."""
    return self._damping * np.append(binding.velocity, 0.0)[self._joint]


class CommandDelay(Operator):
  """The actuator receives the command `delay` seconds late.

  Commands are held between control steps. A delay that is not a whole number of physics steps mixes
  the two neighbouring commands, which is the mean of the delayed command over the step. Before the
  first command has arrived, the one before the episode is taken, or the first where none is known.
  """

  def bind(self, binding: Binding) -> None:
    delay = self.per_actuator(binding)["delay"] / binding.timestep
    whole = np.floor(delay + 1e-9)
    self._fraction = np.maximum(delay - whole, 0.0)
    self._fraction[self._fraction < 1e-9] = 0.0
    self._whole = whole.astype(int)
    self._ring = StepRing(int(self._whole.max(initial=0)) + 2, binding.model.nu)
    self._uniform = len(set(delay.tolist())) == 1
    self.reset()

  def reset(self) -> None:
    self._empty = True

  def command(self, time: float, ctrl: Array) -> None:
    ring = self._ring
    if self._empty:
      ring.fill(ctrl)
      self._empty = False
    else:
      ring.push(ctrl)
    if self._uniform:
      whole, fraction = int(self._whole[0]), float(self._fraction[0])
      ctrl[:] = ring.back(whole)
      if fraction:
        ctrl *= 1 - fraction
        ctrl += fraction * ring.back(whole + 1)
      return
    newer, older = ring.back_each(self._whole), ring.back_each(self._whole + 1)
    ctrl[:] = np.where(self._fraction > 0, newer + self._fraction * (older - newer), newer)


class MotorGain(Operator):
  """The actuator's force is `gain` times the declared one, before its limits or with them.

  A motor whose torque is less than its current's should give slows down less by its own back-EMF,
  too, which servos' models have in the joint's damping: `scales_damping` says that it follows.
  A servo whose gain for position alone differs keeps its own damping: `position_alone`.
  """

  def bind(self, binding: Binding) -> None:
    parameters = self.per_actuator(binding)
    gain = parameters["gain"]
    limit = np.where(parameters["scales_limit"] > 0, gain, 1.0)
    binding.model.actuator_forcerange *= limit[:, None]
    binding.model.actuator_gainprm[:, 0] *= gain
    binding.model.actuator_biasprm[:, :2] *= gain[:, None]
    binding.model.actuator_biasprm[:, 2] *= np.where(parameters["position_alone"] > 0, 1.0, gain)
    driven = binding.actuator_joint >= 0
    dofs = np.arange(binding.model.nv)[binding.dofs][binding.actuator_joint[driven]]
    damping = np.where(parameters["scales_damping"] > 0, gain, 1.0)
    binding.model.dof_damping[dofs] *= damping[driven]


class EncoderOffset(Operator):
  """The encoder reads `offset` too much: measured, and used by a position servo's own loop."""

  def bind(self, binding: Binding) -> None:
    self._offset = self.per_joint(binding)["offset"]
    binding.encoder_offset[:] = self._offset
    model, joint = binding.model, np.maximum(binding.actuator_joint, 0)
    if model.nu:
      stiffness = model.actuator_biasprm[:, 1] * binding.gear
      shift = np.where(binding.actuator_joint >= 0, stiffness * self._offset[joint], 0.0)
      model.actuator_biasprm[:, 0] += shift

  def observe(self, channel: str, value: Array, time: float) -> Array:
    return value + self._offset if channel == "joint_positions" else value


class TorqueLimit(Operator):
  """The actuator gives no more than `limit` in either direction."""

  def bind(self, binding: Binding) -> None:
    model = binding.model
    limit = self.per_actuator(binding)["limit"] / np.maximum(np.abs(binding.gear), 1e-9)
    for index in np.flatnonzero(np.isfinite(limit)):
      low, high = model.actuator_forcerange[index]
      if not model.actuator_forcelimited[index]:
        low, high = -math.inf, math.inf
      model.actuator_forcerange[index] = max(low, -limit[index]), min(high, limit[index])
      model.actuator_forcelimited[index] = 1


class ThermalDerating(Operator):
  """The actuator heats with the square of its torque and weakens as it does.

  dT/dt = heating * torque^2 - T / time_constant, with T the rise above the start; its strength is
  1 - derating * T, at least 0.1. With `back_emf` the torque is the current's: i^2 R heats.
  """

  def bind(self, binding: Binding) -> None:
    parameters = self.per_actuator(binding)
    step = binding.timestep
    self._heating = parameters["heating"] * step
    self._cooling = 1 - step / np.maximum(parameters["time_constant"], step)
    self._derating = parameters["derating"]
    self._scales_limit = parameters["scales_limit"] > 0
    self._back_emf = parameters["back_emf"] > 0
    self._torque = _Torque(binding)
    self.temperature_rise = np.zeros(binding.model.nu)
    """K, [U]."""

  def reset(self) -> None:
    self.temperature_rise[:] = 0.0

  def step(self, binding: Binding) -> None:
    rise, torque = self.temperature_rise, self._torque.at_joints(binding)
    if self._back_emf.any():
      torque = torque - np.where(self._back_emf, self._torque.of_back_emf(binding), 0.0)
    _WARMED(rise, torque, self._heating, self._cooling, rise)
    strength = _STRENGTH_OF_HEAT(rise, self._derating)
    binding.strength *= strength
    if self._scales_limit.any():
      binding.limit *= np.where(self._scales_limit, strength, 1.0)


class SupplySag(Operator):
  """All actuators weaken together as the supply's voltage falls under load and with time.

  Strength is 1 - droop * load - fade * time, at least 0.1; the load is the sum of |torque| of the
  last step. With `back_emf` an actuator with a limit, its torque at full duty, adds what its bridge
  draws in its place, negative where it gives back: duty times current in the mean, or, `pulsed`,
  the current itself, which flows while the bridge is on and lowers what the motor has of it then.
  """

  def bind(self, binding: Binding) -> None:
    if len(self.effects) > 1 or self.effects[0].target is not None:
      raise ValueError("Found a target, or more than one supply_sag; expected one, with no target.")
    self._droop = self.value(self.effects[0], "droop")
    self._fade = self.value(self.effects[0], "fade")
    self._scales_limit = self.value(self.effects[0], "scales_limit") > 0
    self._torque = _Torque(binding)
    limit = np.abs(binding.model.actuator_forcerange[:, 1] * binding.gear)
    bridges = binding.model.actuator_forcelimited.astype(bool) & (
      self.value(self.effects[0], "back_emf") > 0
    )
    self._per_limit = np.where(bridges, 1.0 / np.maximum(limit, 1e-9), 0.0)
    self._others, self._pulsed = ~bridges, self.value(self.effects[0], "pulsed") > 0
    self.reset()

  def reset(self) -> None:
    self._strength = 1.0

  def step(self, binding: Binding) -> None:
    torque, time = self._torque.at_joints(binding), binding.data.time
    load = float(np.abs(torque[self._others]).sum())
    if self._others.all():
      strength = laws.strength_of_supply(load, time, self._droop, self._fade)
    else:
      full = torque / self._strength
      duty = np.sign(full) * ~self._others if self._pulsed else full * self._per_limit
      drawn, spared = float(duty @ full), float(duty @ self._torque.of_back_emf(binding))
      strength = laws.strength_of_source(drawn, spared, load, time, self._droop, self._fade)
    self._strength = strength
    binding.strength *= strength
    if self._scales_limit:
      binding.limit *= strength


def _choice(name: str, doc: str) -> Parameter:
  """Returns a parameter that chooses between models: 0 or 1."""
  return Parameter(
    name, "1", 0.0, 0.0, 1.0, doc, minimum=0.0, maximum=1.0, shape=True, fitted=False
  )


_SCALES_LIMIT = _choice("scales_limit", "1 if the actuator's limits weaken with it, 0 if they stay")
_BACK_EMF = _choice(
  "back_emf", "1 if the joint's damping is a motor's back-EMF, which takes from the current, else 0"
)

_PULSED = _choice(
  "pulsed", "1 if no capacitor averages what a bridge draws, the motor's current while on, else 0"
)


KINDS = (
  Kind(
    "command_delay",
    "the command reaches the actuator late",
    "joint",
    "command",
    (Parameter("delay", "s", 0.0, 0.0, 0.2, "latency", minimum=0.0, maximum=2.0),),
    CommandDelay,
  ),
  Kind(
    "motor_gain",
    "the actuator is stronger or weaker than declared",
    "joint",
    "model",
    (
      Parameter("gain", "1", 1.0, 0.1, 1.6, "true over declared force", minimum=0.0),
      _SCALES_LIMIT,
      _choice(
        "scales_damping",
        "1 if the joint's damping (a motor's back-EMF) falls with it, 0 if it stays",
      ),
      _choice(
        "position_alone", "1 if the actuator's own damping stays, 0 if it is scaled with its gain"
      ),
    ),
    MotorGain,
  ),
  Kind(
    "encoder_offset",
    "the encoder reads too much by a constant",
    "joint",
    "model",
    (Parameter("offset", "rad", 0.0, -0.15, 0.15, "reading minus truth"),),
    EncoderOffset,
  ),
  Kind(
    "torque_limit",
    "the actuator saturates earlier than declared",
    "joint",
    "model",
    (Parameter("limit", "N m", math.inf, 0.2, 5.0, "largest torque", minimum=0.0),),
    TorqueLimit,
  ),
  Kind(
    "thermal_derating",
    "the actuator weakens as it heats up",
    "joint",
    "actuator",
    (
      Parameter("heating", "K/(s N^2 m^2)", 0.0, 0.0, 5.0, "heating by torque", minimum=0.0),
      Parameter("time_constant", "s", 300.0, 20.0, 1000.0, "of cooling", minimum=1e-3, shape=True),
      Parameter("derating", "1/K", 0.004, 0.001, 0.02, "loss per kelvin", minimum=0.0, shape=True),
      _SCALES_LIMIT,
      _BACK_EMF,
    ),
    ThermalDerating,
  ),
  Kind(
    "supply_sag",
    "the supply's voltage falls with load and time, all actuators weaken",
    "none",
    "actuator",
    (
      Parameter("droop", "1/(N m)", 0.0, 0.0, 0.4, "loss per total torque", minimum=0.0),
      Parameter("fade", "1/s", 0.0, 0.0, 0.03, "loss per second", minimum=0.0),
      _SCALES_LIMIT,
      _BACK_EMF,
      _PULSED,
    ),
    SupplySag,
  ),
)
