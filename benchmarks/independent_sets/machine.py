"""One copy of an apparatus: every constant that its motion depends on, and how copies differ."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Machine:
  """Constants of one machine [n], or of a batch [B, n]; [1] or [B, 1] where all joints share it.

  Rotor, friction and motor are seen from the output, behind the gear (N m and rad, or N and m).
  """

  mass: Array  # kg of every link
  inertia: Array  # kg m^2 of every link about its joint
  moment_x: Array  # kg m, mass times its centre's x
  moment_z: Array
  length: Array  # m of the first link
  gravity: Array  # m/s^2
  tilt: Array  # rad by which gravity, or an axis, is off
  rotor: Array  # kg m^2
  gear_stiffness: Array
  gear_damping: Array
  half_gap: Array
  viscous: Array
  coulomb: Array
  presliding: Array  # rad of motion before all of the friction slides
  fall: Array  # share by which friction is larger at rest
  fall_speed: Array
  stribeck: Array  # effect, on top
  stribeck_speed: Array
  dwell_friction: Array  # what friction grows by at rest
  dwell_time: Array
  patch_depth: Array
  patch_place: Array
  patch_width: Array
  spring: Array  # one-sided
  spring_begins: Array
  torque_constant: Array  # N m/A
  nominal_constant: Array  # as the controller has it
  resistance: Array
  inductance: Array
  volts: Array
  fade: Array  # share of the voltage lost a second
  supply_resistance: Array
  current_limit: Array
  duty_limit: Array
  dead_band: Array
  current_time: Array  # s, of the current loop
  servo_gain: Array  # duty per rad
  position_gain: Array
  velocity_gain: Array
  rate_filter: Array  # s
  count: Array  # rad, the encoder's step
  zero: Array
  zero_drift: Array
  drift_time: Array
  command_delay: Array  # s until a command acts
  measurement_delay: Array
  slides: bool = False

  def change(self, **values: Any) -> "Machine":
    """Returns a copy with other constants."""
    return dataclasses.replace(self, **values)


def stack(machines: Sequence[Machine]) -> Machine:
  """Returns a batch, constants [B, n]."""
  arrays = {
    field.name: np.stack([getattr(machine, field.name) for machine in machines])
    for field in dataclasses.fields(Machine)
    if field.name != "slides"
  }
  return Machine(**arrays, slides=machines[0].slides)


SCATTER = {
  **dict.fromkeys(("mass", "inertia", "moment_x", "moment_z"), 0.01),
  **dict.fromkeys(("rotor", "torque_constant", "resistance"), 0.02),
  **dict.fromkeys(("viscous", "inductance"), 0.05),
  **dict.fromkeys(("coulomb", "presliding", "fall", "gear_stiffness"), 0.15),
}
"""Standard deviations by which copies differ; chosen: weighed, catalogue, bearing, grease."""
WARMTH = 0.03
"""Standard deviation by which friction differs between two sessions of one machine."""
LEVEL = 2e-3
"""rad, standard deviation of how level a machine stands."""


def scattered(nominal: Machine, rng: np.random.Generator) -> Machine:
  """Returns one copy of a machine: what a healthy one differs by from its data sheet."""
  values = {}
  for name, share in SCATTER.items():
    array = getattr(nominal, name)
    factor = 1 + share * np.clip(rng.normal(size=array.shape), -2.5, 2.5)
    values[name] = array * factor
  # A heavier link is heavier about its joint, too: one factor, the shape's own beside it.
  values["inertia"] = values["inertia"] * values["mass"] / nominal.mass
  values["tilt"] = nominal.tilt + LEVEL * rng.normal()
  values["zero"] = nominal.zero + nominal.count * rng.uniform(-0.5, 0.5, nominal.count.shape)
  return nominal.change(**values)


def warmed(machine: Machine, rng: np.random.Generator) -> Machine:
  """Returns the machine at another session: warmer or colder grease."""
  factor = np.exp(WARMTH * rng.normal())
  return machine.change(coulomb=machine.coulomb * factor, viscous=machine.viscous * factor)
