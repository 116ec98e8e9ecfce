"""What effects change in the machine of a blind set."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .machine import Machine, turn_gravity
from .plant import FULL_DUTY
from .rigid_body import attach_point_mass

Parameters = dict[str, float]
Apply = Callable[[Machine, Any, Parameters], None]


def adds(**fields: str) -> Apply:
  """Returns an `apply` that adds parameters to fields of the servo: field=parameter."""

  def apply(machine: Machine, joint: Any, parameters: Parameters) -> None:
    for field, parameter in fields.items():
      getattr(machine.servo, field)[joint] += parameters[parameter]

  return apply


def sets(**fields: str) -> Apply:
  """Returns an `apply` that replaces fields of the servo by parameters."""

  def apply(machine: Machine, joint: Any, parameters: Parameters) -> None:
    for field, parameter in fields.items():
      getattr(machine.servo, field)[joint] = parameters[parameter]

  return apply


def stribeck(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Sets extra friction at rest and the speed over which it falls."""
  machine.servo.breakaway[joint] = parameters["breakaway"]
  machine.servo.stribeck_velocity[joint] = parameters["velocity"]


def measurement_delay(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Sets how late readings are [s]."""
  machine.measurement_delay[joint] = parameters["delay"]


def clock_drift(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Sets the rate of the readings' clock."""
  machine.clock_rate = parameters["rate"]
  machine.stamps_only = bool(parameters["stamps_only"])


def motor_gain(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Scales the motor, or the gain register."""
  gain = parameters["gain"]
  if parameters["limit_scales"]:  # a weaker magnet or winding
    machine.servo.stall[joint] *= gain
    if not parameters["effort_sees_it"]:
      machine.effort_scale[joint] = 1 / gain
  else:  # a gain register that is not the documented one
    machine.servo.register[joint] = np.round(machine.servo.register[joint] * gain)


def supply_sag(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Sets the supply's droop under load and its fade."""
  machine.world = machine.world._replace(droop=parameters["droop"], fade=parameters["fade"])


def torque_limit(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Lowers the duty at which the servo saturates."""
  share = parameters["limit"] / machine.servo.stall[joint]
  machine.servo.duty_limit[joint] = np.floor(FULL_DUTY * share)


def payload(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Attaches a point mass to a link."""
  place = machine.tree.center[joint] + np.array([parameters[f"off_{axis}"] for axis in "xyz"])
  machine.tree = attach_point_mass(machine.tree, joint, parameters["mass"], place)


def gravity_tilt(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Turns gravity."""
  turn_gravity(machine, parameters["x"], parameters["y"])


def parameter_error(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Scales constants of all servos."""
  servo = machine.servo
  servo.viscous[:] *= parameters["damping"]
  servo.coulomb[:] *= parameters["friction"]
  servo.motor_inertia[:] *= parameters["armature"]
  servo.output_inertia[:] *= parameters["armature"]


def dropout(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Draws spans in which the servo is without power."""
  rng = np.random.default_rng(int(parameters["seed"]))
  time = rng.exponential(parameters["every"])
  while time < 60:
    machine.dropouts.append((joint, time, time + parameters["lasting"]))
    time += parameters["lasting"] + rng.exponential(parameters["every"])


def soft_stop(machine: Machine, joint: Any, parameters: Parameters) -> None:
  """Sets a soft stop on one side."""
  servo, side = machine.servo, parameters["side"]
  servo.stop_side[joint], servo.stop_stiffness[joint] = side, parameters["stiffness"]
  servo.stop_angle[joint] = parameters["place"] * side + parameters["center"]
