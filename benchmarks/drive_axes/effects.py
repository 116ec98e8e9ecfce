"""What can be wrong with a machine: kinds that the library names, and kinds that it does not.

`size` in 0 to 1 runs through a kind's range; `shape` [4] in 0 to 1 draws everything else. Sizes of
torques go by the axis' limit, so that they fit newton metres and newtons alike.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.drive_axes.plants import PLANTS, Machine, change
from benchmarks.drive_axes.recording import Host

Array = np.ndarray
Parameters = dict[str, float]
HINGED = ("swing", "planar")


class Broken(NamedTuple):
  """A machine and its host, with the parameters of what was done to them."""

  machine: Machine
  host: Host
  parameters: Parameters


class Kind(NamedTuple):
  """A kind of effect."""

  apply: Callable[[Machine, Host, int, float, Array], Broken]
  plants: tuple[str, ...] = PLANTS
  group: str = ""
  """Two of one group may make up for each other and are never drawn together."""
  joint: bool = True
  """Whether it is of one joint."""


def _between(low: float, high: float, size: float) -> float:
  """Returns low (high / low)^size."""
  return low * (high / low) ** size


def _side(share: float) -> float:
  return 1.0 if share < 0.5 else -1.0


def _on_axis(law: Callable[..., tuple[dict[str, float], Parameters]]):
  """Returns how a law of (axis' constants, reach, size, shape) changes one joint's constants."""

  def apply(machine: Machine, host: Host, joint: int, size: float, shape: Array) -> Broken:
    one = {name: float(value[joint]) for name, value in machine.axes._asdict().items()}
    values, parameters = law(one, machine.reach[joint], size, shape)
    axes = change(machine.axes, joint, **values)
    return Broken(dataclasses.replace(machine, axes=axes), host, parameters)

  return apply


def _on_host(name: str, low: float, high: float, parameter: str, *, signed: bool = False):
  def apply(machine: Machine, host: Host, joint: int, size: float, shape: Array) -> Broken:
    value = _between(low, high, size) * (_side(shape[0]) if signed else 1.0)
    changed: dict[str, Any] = {name: value}
    return Broken(machine, host._replace(**changed), {parameter: value})

  return apply


def _coulomb(a, reach, size, shape):
  torque = a["limit"] * _between(0.02, 0.35, size)
  return {"more_dry": torque}, {"torque": torque}


def _viscous(a, reach, size, shape):
  more = a["speed_gain"] * _between(0.05, 0.6, size)
  return {"viscous": a["viscous"] + more}, {"coefficient": more}


def _stribeck(a, reach, size, shape):
  breakaway = a["limit"] * _between(0.05, 0.5, size)
  velocity = reach.speed * _between(0.05, 0.25, shape[0])
  values = {"more_breakaway": breakaway, "more_fall": velocity}
  return values, {"breakaway": breakaway, "velocity": velocity}


def _of_load(a, reach, size, shape):
  share = _between(0.08, 0.5, size)
  return {"of_load": a["of_load"] + share}, {"coefficient": share}


def _asymmetric(a, reach, size, shape):
  torques = a["limit"] * _between(0.03, 0.4, size) * np.array([1.0, _between(0.1, 0.5, shape[0])])
  positive, negative = torques if shape[1] < 0.5 else torques[::-1]
  values = {"more_dry": 0.5 * (positive + negative), "offset": 0.5 * (negative - positive)}
  return values, {"positive": float(positive), "negative": float(negative)}


def _drag(a, reach, size, shape):
  drag = a["speed_gain"] / reach.speed * _between(0.1, 1.0, size)
  return {"drag": drag}, {"coefficient": drag}


def _play(a, reach, size, shape):
  gap = reach.amplitude * _between(0.006, 0.06, size)
  return {"half_play": 0.5 * gap}, {"gap": gap, "encoder_on_motor": 0.0}


def _gain(a, reach, size, shape):
  weak = 1.0 - _between(0.08, 0.55, size)
  if shape[0] < 0.5:  # magnets that have lost strength: the current is as ever
    return {"gain": a["gain"] * weak}, {"gain": weak, "scales_limit": 1.0, "position_alone": 0.0}
  gain = weak if shape[1] < 0.7 else 2.0 - weak
  values = {"position_gain": a["position_gain"] * gain}
  return values, {"gain": gain, "scales_limit": 0.0, "position_alone": 1.0}


def _limit(a, reach, size, shape):
  limit = a["limit"] * (1.0 - _between(0.3, 0.85, size))
  return {"limit": limit}, {"limit": limit * a["gain"]}


def _spring(a, reach, size, shape):
  stiffness = a["position_gain"] * a["speed_gain"] * _between(0.02, 0.25, size)
  at = reach.amplitude * (shape[0] - 0.5)
  return {"spring": stiffness, "spring_at": at}, {"stiffness": stiffness, "reference": at}


def _cogging(a, reach, size, shape):
  amplitude = a["limit"] * _between(0.02, 0.25, size)
  waves = _between(4.0, 25.0, shape[0]) / reach.amplitude
  phase = math.pi * (2.0 * shape[1] - 1.0)
  values = {"cogging": amplitude, "cogging_waves": waves, "cogging_phase": phase}
  return values, {"amplitude": amplitude, "periods": waves, "phase": phase}


def _rotor(a, reach, size, shape):
  factor = 1.0 + _between(0.3, 2.0, size)
  return {"rotor": a["rotor"] * factor}, {"armature": factor}


def _payload(machine: Machine, host: Host, joint: int, size: float, shape: Array) -> Broken:
  links = machine.links
  mass = links.mass[joint] * _between(0.08, 0.8, size)
  reach = 0.0 if machine.plant == "lift" else links.length[joint] * (0.5 + 0.5 * shape[0])
  load, at = links.load.copy(), links.reach.copy()
  load[joint], at[joint] = mass, reach
  machine = dataclasses.replace(machine, links=links._replace(load=load, reach=at))
  place = {"x": 0.0, "y": 0.0, "z": 0.0}
  place |= {"x": reach} if machine.plant == "swing" else {"z": -reach}
  return Broken(machine, host, {"mass": mass, **place})


def _tilt(machine: Machine, host: Host, joint: int, size: float, shape: Array) -> Broken:
  angle, way = _between(0.03, 0.2, size), math.tau * shape[0]
  x, y = angle * math.cos(way), angle * math.sin(way)
  if machine.plant == "planar":  # beside the arm's plane it shows nothing
    x, y = 0.0, angle * _side(shape[0])
  links = machine.links._replace(tilt=np.array([x, y]))
  return Broken(dataclasses.replace(machine, links=links), host, {"x": x, "y": y})


def _smoothing(a, reach, size, shape):
  time = _between(0.005, 0.1, size)
  return {"smoothing": time}, {"time": time}


def _slow(a, reach, size, shape):
  speed = reach.speed * _between(0.8, 0.15, size)
  return {"most_speed": speed}, {"speed": speed}


def _integral(a, reach, size, shape):
  factor = _between(4.0, 60.0, size)
  return {"integral_time": a["integral_time"] / factor}, {"factor": factor}


def _cold(a, reach, size, shape):
  cold, warming = a["speed_gain"] * _between(0.1, 1.0, size), _between(2.0, 6.0, shape[0])
  return {"cold": cold, "warming": warming}, {"coefficient": cold, "time": warming}


def _spot(a, reach, size, shape):
  torque, at = a["limit"] * _between(0.06, 0.5, size), 0.6 * reach.amplitude * (shape[0] - 0.5)
  values = {"spot": torque, "spot_at": at, "spot_width": reach.amplitude * (0.04 + 0.08 * shape[1])}
  return values, {"torque": torque, "at": at, "width": values["spot_width"]}


def _belt(a, reach, size, shape):
  torque = a["limit"] * _between(0.4, 0.1, size)
  return {"slips_at": torque}, {"torque": torque}


def _cable(a, reach, size, shape):
  stiffness = a["position_gain"] * a["speed_gain"] * _between(0.05, 1.0, size)
  at = reach.amplitude * 0.4 * (shape[0] - 0.3)
  return {"cable": stiffness, "cable_at": at}, {"stiffness": stiffness, "at": at}


def _brake(a, reach, size, shape):
  torque, period = a["limit"] * _between(0.05, 0.4, size), _between(1.5, 5.0, shape[0])
  return {"brake": torque, "brake_period": period}, {"torque": torque, "period": period}


def _slosh(a, reach, size, shape):
  whole = a["speed_gain"] / 50.0  # of the order of what the motor moves
  inertia, rate = whole * _between(0.05, 0.5, size), math.tau * _between(1.0, 2.5, shape[0])
  values = {"slosh": inertia, "slosh_rate": rate, "slosh_damping": 0.03 + 0.07 * shape[1]}
  return values, {"inertia": inertia, "frequency": rate / math.tau}


LIBRARY = {
  "command_delay": Kind(_on_host("command_delay", 0.004, 0.08, "delay"), group="time", joint=False),
  "measurement_delay": Kind(
    _on_host("reading_delay", 0.004, 0.06, "delay"), group="time", joint=False
  ),
  "clock_drift": Kind(
    _on_host("clock_rate", 5e-4, 1e-2, "rate", signed=True), group="time", joint=False
  ),
  "coulomb_friction": Kind(_on_axis(_coulomb), group="dry"),
  "viscous_friction": Kind(_on_axis(_viscous), group="damped"),
  "stribeck_friction": Kind(_on_axis(_stribeck), group="dry"),
  "load_friction": Kind(_on_axis(_of_load), group="dry"),
  "asymmetric_friction": Kind(_on_axis(_asymmetric), group="dry"),
  "quadratic_drag": Kind(_on_axis(_drag), group="damped"),
  "backlash": Kind(_on_axis(_play), HINGED, group="play"),
  "motor_gain": Kind(_on_axis(_gain), group="strength"),
  "torque_limit": Kind(_on_axis(_limit), group="strength"),
  "payload": Kind(_payload, group="mass"),
  "spring": Kind(_on_axis(_spring), group="position"),
  "cogging": Kind(_on_axis(_cogging), group="position"),
  "gravity_tilt": Kind(_tilt, HINGED, group="mass", joint=False),
  "parameter_error": Kind(_on_axis(_rotor), group="mass"),
}
"""By the library's names (suite/effects)."""

OUTSIDE = {
  "command_smoothing": Kind(_on_axis(_smoothing)),
  "speed_limit": Kind(_on_axis(_slow)),
  "strong_integral": Kind(_on_axis(_integral), HINGED),
  "warming_grease": Kind(_on_axis(_cold)),
  "friction_spot": Kind(_on_axis(_spot)),
  "belt_slip": Kind(_on_axis(_belt), ("planar",)),
  "tight_cable": Kind(_on_axis(_cable)),
  "dragging_brake": Kind(_on_axis(_brake)),
  "sloshing_load": Kind(_on_axis(_slosh)),
}
"""What no library names."""
