"""What may be wrong with a bench: 20 kinds that the library names, 8 that it does not.

An effect is a function of a machine, its size and its shape: (machine, x, u) to the machine with it
and the parameters of the truth. x runs from 0, what a careful engineer still sees, to 1, large; u
are four uniform draws, of which come places, phases and variants. Conventions: README.md.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.servo_bench import loop, motor
from benchmarks.servo_bench.bench import GRAVITY, Paper, between
from benchmarks.servo_bench.recording import Host
from benchmarks.servo_bench.simulation import Bench

Array = np.ndarray
Parameters = dict[str, Any]


class Machine(NamedTuple):
  """A copy of a bench with the host beside it."""

  paper: Paper
  bench: Bench
  host: Host

  def change(self, part: str, **values: Any) -> "Machine":
    """Returns the machine with other constants in a part of its bench, or in `host`."""
    if part == "host":
      return self._replace(host=self.host._replace(**values))
    changed = getattr(self.bench, part)._replace(**values)
    return self._replace(bench=self.bench._replace(**{part: changed}))


Apply = Callable[[Machine, float, Array], tuple[Machine, Parameters]]
UPRIGHT = ("hanging", "bent", "level")


class Kind(NamedTuple):
  """One kind of effect."""

  apply: Apply
  group: str
  """Two effects of a pair are of different groups: within one they may look alike."""
  plants: tuple[str, ...] = (*UPRIGHT, "turntable")
  """Where it can be seen, and not be mistaken for another by anyone."""
  joint: bool = True
  """Whether it has a place: the joint."""


def _sign(share: float) -> float:
  return 1.0 if share < 0.5 else -1.0


def _stall(machine: Machine) -> float:
  return motor.stall_torque(machine.bench.motor)


def _command_delay(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  delay = between(0.008, 0.04, x)
  return machine.change("host", command_delay=delay), {"delay": delay}


def _measurement_delay(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  delay = between(0.008, 0.04, x)
  return machine.change("host", reading_delay=delay), {"delay": delay}


def _clock_drift(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  rate = _sign(u[0]) * between(0.001, 0.01, x)
  return machine.change("host", clock_rate=rate), {"rate": rate}


def _motor_gain(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  m, firmware = machine.bench.motor, machine.bench.loop
  if u[0] < 0.5:  # worn brushes: less current at any duty, less braking by back-EMF
    gain = between(0.85, 0.45, x)
    shape = {"scales_limit": 1, "scales_damping": 1, "position_alone": 0}
    return machine.change("motor", resistance=m.resistance / gain), {"gain": gain, **shape}
  gain = between(0.8, 0.4, x) if u[1] < 0.6 else between(1.25, 1.7, x)
  whole = round(firmware.gain * gain)
  shape = {"scales_limit": 0, "scales_damping": 0, "position_alone": 1}
  return machine.change("loop", gain=whole), {"gain": whole / firmware.gain, **shape}


def _torque_limit(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  steps = machine.bench.loop.steps
  limit = round(steps * between(0.6, 0.2, x))
  return machine.change("loop", limit=limit), {"limit": limit / steps * _stall(machine)}


def _supply_sag(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  if u[0] < 0.3:  # a pack that is nearly empty
    fade = between(0.008, 0.03, x)
    return machine.change("motor", fade=fade), {"fade": fade}
  ohms = machine.bench.motor.resistance * between(0.15, 1.0, x)  # a thin cable, a bad plug
  return machine.change("motor", source_resistance=ohms), {"source_resistance": ohms}


def _thermal_derating(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  m = machine.bench.motor
  values = {
    "heat_capacity": m.heat_capacity / between(4.0, 30.0, x),
    "cooling_time": between(15.0, 60.0, u[0]),
    "derating": 0.006 + 0.014 * u[1],
  }
  return machine.change("motor", **values), values


def _coulomb_friction(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  torque = _stall(machine) * between(0.02, 0.12, x)
  coulomb = machine.bench.friction.coulomb + torque
  return machine.change("friction", coulomb=coulomb), {"torque": torque}


def _viscous_friction(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  m, before = machine.bench.motor, machine.bench.friction.viscous
  added = m.constant**2 / m.resistance * between(0.1, 0.8, x)
  return machine.change("friction", viscous=before + added), {"coefficient": added}


def _stribeck_friction(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  added, speed = _stall(machine) * between(0.03, 0.2, x), between(0.03, 0.3, u[0])
  breakaway = machine.bench.friction.breakaway + added
  changed = machine.change("friction", breakaway=breakaway, stribeck_speed=speed)
  return changed, {"breakaway": added, "velocity": speed}


def _load_friction(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  added = between(0.08, 0.4, x)
  return machine.change("friction", load=machine.bench.friction.load + added), {
    "coefficient": added
  }


def _asymmetric_friction(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  more = _stall(machine) * between(0.03, 0.15, x)
  less = 0.3 * u[1] * more
  positive, negative = (more, less) if u[0] < 0.5 else (less, more)
  values = {"positive": positive, "negative": negative}
  return machine.change("friction", **values), values


def _quadratic_drag(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  fast = 0.6 * motor.no_load_speed(machine.bench.motor)
  drag = _stall(machine) * between(0.08, 0.5, x) / fast**2
  return machine.change("arm", drag=drag), {"coefficient": drag}


def _backlash(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  gap = between(0.008, 0.05, x)
  return machine.change("gear", play=gap), {"gap": gap, "encoder_on_motor": 0}


def _payload(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  paper, a = machine.paper, machine.bench.arm
  mass = paper.mass * between(0.12, 1.0, x)
  radius = paper.radius * (0.8 + 0.9 * u[0])
  first, second = (round(radius * f(paper.direction), 9) for f in (math.cos, math.sin))
  upright = paper.plant != "turntable"
  x_, y_, z_ = (second, 0.0, first) if upright else (first, second, 0.0)
  changed = machine.change(
    "arm",
    inertia=a.inertia + mass * radius**2,
    moment_1=a.moment_1 + mass * first,
    moment_2=a.moment_2 + mass * second,
  )
  return changed, {"body": "arm", "mass": mass, "x": x_, "y": y_, "z": z_}


def _spring(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  stiffness, angle = _stall(machine) * between(0.05, 0.5, x), u[0] - 0.5
  changed = machine.change("arm", spring=stiffness, spring_angle=angle)
  return changed, {"stiffness": stiffness, "reference": angle}


def _cogging(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  torque, periods = _stall(machine) * between(0.02, 0.12, x), between(5.0, 25.0, u[0])
  phase = math.tau * (u[1] - 0.5)
  changed = machine.change("arm", ripple=torque, ripple_periods=periods, ripple_phase=phase)
  return changed, {"amplitude": torque, "periods": periods, "phase": phase}


def _gravity_tilt(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  # Of a vertical axis alone: rotation vector (x, y) of a gravity that was (0, 0, -g).
  tilt, a = between(0.03, 0.2, x), machine.bench.arm
  along_x, along_y = tilt * math.cos(math.tau * u[0]), tilt * math.sin(math.tau * u[0])
  sideways = GRAVITY * math.sin(tilt) / tilt
  changed = machine.change(
    "arm",
    gravity_1=a.gravity_1 - sideways * along_y,
    gravity_2=a.gravity_2 + sideways * along_x,
  )
  return changed, {"x": along_x, "y": along_y}


def _encoder_offset(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  offset = _sign(u[0]) * between(0.03, 0.15, x)
  return machine.change("loop", offset=machine.bench.loop.offset + offset), {"offset": offset}


def _parameter_error(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  factor = between(1.5, 4.0, x)  # a gear head or flywheel that the datasheet has not
  rotor = machine.bench.gear.rotor * factor
  return machine.change("gear", rotor=rotor), {"armature": factor}


LIBRARY: dict[str, Kind] = {
  "command_delay": Kind(_command_delay, "time"),
  "measurement_delay": Kind(_measurement_delay, "time"),
  "clock_drift": Kind(_clock_drift, "time", joint=False),
  "motor_gain": Kind(_motor_gain, "strength"),
  "torque_limit": Kind(_torque_limit, "strength"),
  "supply_sag": Kind(_supply_sag, "strength", joint=False),
  "thermal_derating": Kind(_thermal_derating, "strength"),
  "coulomb_friction": Kind(_coulomb_friction, "dry"),
  "stribeck_friction": Kind(_stribeck_friction, "dry"),
  "load_friction": Kind(_load_friction, "dry"),
  "asymmetric_friction": Kind(_asymmetric_friction, "dry"),
  "viscous_friction": Kind(_viscous_friction, "speed"),
  "quadratic_drag": Kind(_quadratic_drag, "speed"),
  "backlash": Kind(_backlash, "play"),
  "payload": Kind(_payload, "mass"),
  "parameter_error": Kind(_parameter_error, "mass"),
  "spring": Kind(_spring, "angle"),
  "cogging": Kind(_cogging, "ripple"),
  "gravity_tilt": Kind(_gravity_tilt, "angle", ("turntable",), joint=False),
  "encoder_offset": Kind(_encoder_offset, "angle", UPRIGHT),
}


def _warming_grease(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  values = {"cold": between(1.0, 5.0, x), "warming_time": between(2.5, 8.0, u[0])}
  return machine.change("friction", **values), values


def _one_sided_spring(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  values = {
    "stop": _stall(machine) * between(0.3, 2.0, x),
    "stop_angle": _sign(u[0]) * (0.05 + 0.25 * u[1]),
  }
  return machine.change("arm", **values), values


def _flexible_link(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  values = {
    "tip_share": 0.5 + 0.4 * u[0],
    "tip_frequency": math.tau * between(7.0, 2.0, x),
    "tip_damping": between(0.015, 0.06, u[1]),
  }
  return machine.change("arm", **values), values


def _sticky_patch(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  values = {
    "patch": _stall(machine) * between(0.05, 0.25, x),
    "patch_angle": 0.8 * (u[0] - 0.5),
    "patch_width": between(0.06, 0.2, u[1]),
  }
  return machine.change("friction", **values), values


def _host_stall(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  values = {"stall": between(0.05, 0.25, x), "stall_period": between(0.7, 1.7, u[0])}
  return machine.change("host", **values), values


def _direction_gain(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  forward = between(0.8, 0.4, x)
  return machine.change("motor", forward=forward), {"forward": forward}


def _slew_limit(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  speed = motor.no_load_speed(machine.bench.motor) * between(0.5, 0.15, x)
  slew = speed * loop.PERIOD * machine.bench.loop.counts / math.tau
  return machine.change("loop", slew=slew), {"speed": speed}


def _cable_hysteresis(machine: Machine, x: float, u: Array) -> tuple[Machine, Parameters]:
  slip = between(0.1, 0.4, u[0])
  cable = _stall(machine) * between(0.04, 0.2, x) / slip
  values = {"cable": cable, "cable_slip": slip}
  return machine.change("arm", **values), values


OUTSIDE: dict[str, Kind] = {
  "warming_grease": Kind(_warming_grease, "dry"),
  "one_sided_spring": Kind(_one_sided_spring, "angle"),
  "flexible_link": Kind(_flexible_link, "mass"),
  "sticky_patch": Kind(_sticky_patch, "dry"),
  "host_stall": Kind(_host_stall, "time", joint=False),
  "direction_gain": Kind(_direction_gain, "strength"),
  "slew_limit": Kind(_slew_limit, "time"),
  "cable_hysteresis": Kind(_cable_hysteresis, "angle"),
}
"""Kinds that no library of effects has."""
