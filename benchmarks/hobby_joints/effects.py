"""What is wrong with a machine: kinds that the library of effects names, and others.

Sizes go from 0 to 1 and are shares of what the servo can, so that small and large ones have effects
alike; a jaw's are its servo's through the pinion.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.hobby_joints.bodies import GRAVITY
from benchmarks.hobby_joints.machines import PLANTS, Machine
from benchmarks.hobby_joints.recording import Host
from nerf2real.core.geometry.rotations import matrix_from_rotvec

Array = np.ndarray
Change = dict[str, float]
Broken = tuple[Machine, Host, Change]
"""The machine with an effect, its host, and the effect's parameters in the library's units."""
Apply = Callable[[Machine, Host, int, float, Array], Broken]


class Kind(NamedTuple):
  """A kind of effect: `apply` takes machine, host, joint, size and four numbers in 0 to 1."""

  apply: Apply
  group: str
  """Kinds of one group do not come together."""
  joint: bool = True
  plants: tuple[str, ...] = PLANTS


def _put(machine: Machine, part: str, j: int, **values: float) -> Machine:
  """Returns a machine with constants of one joint changed."""
  old = getattr(machine, part)
  new = {name: np.array(getattr(old, name)) for name in values}
  for name, value in values.items():
    new[name][j] = value
  return dataclasses.replace(machine, **{part: old._replace(**new)})


def _gear(machine: Machine, j: int, **values: float) -> Machine:
  return _put(machine, "gear", j, **values)


def _drive(machine: Machine, j: int, **values: float) -> Machine:
  return _put(machine, "drive", j, **values)


def _sign(share: float) -> float:
  return 1.0 if share < 0.5 else -1.0


def _coulomb(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  torque = m.stall[j] * (0.02 + 0.12 * size)
  return _gear(m, j, dry=m.gear.dry[j] + torque), h, {"torque": torque}


def _viscous(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  more = m.back_emf[j] * (0.15 + 0.85 * size)
  return _gear(m, j, viscous=m.gear.viscous[j] + more), h, {"coefficient": more}


def _stribeck(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  more, speed = m.stall[j] * (0.02 + 0.13 * size), (0.05 + 0.35 * shape[0]) * m.radius[j]
  machine = _gear(m, j, more_rest=more, more_speed=speed)
  return machine, h, {"breakaway": more, "velocity": speed}


def _load(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  share = 0.06 + 0.3 * size
  machine = _gear(m, j, of_load=m.gear.of_load[j] + share)
  return machine, h, {"coefficient": share, "carried": 2.0}


def _asymmetric(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  sides = m.stall[j] * (0.03 + 0.12 * size) * np.array([1.0, 0.4 * shape[0]])
  forward, backward = sides if shape[1] < 0.5 else sides[::-1]
  machine = _gear(m, j, forward=forward, backward=backward)
  return machine, h, {"positive": forward, "negative": backward}


def _drag(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  half = 0.5 * m.supply.voltage / m.drive.constant[j]  # of the speed without load
  more = m.stall[j] * (0.05 + 0.3 * size) / half**2
  return _gear(m, j, drag=more), h, {"coefficient": more}


def _backlash(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  gap = 0.01 + 0.04 * size
  return _gear(m, j, gap=gap), h, {"gap": gap}


def _spring(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  of = m.ranges[j]
  stiffness = m.stall[j] * (0.08 + 0.5 * size) / m.radius[j]
  reference = of.centre + (shape[0] - 0.5) * of.amplitude
  machine = _gear(m, j, spring=stiffness, spring_at=reference)
  return machine, h, {"stiffness": stiffness, "reference": reference}


def _cogging(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  torque, periods = m.stall[j] * (0.02 + 0.1 * size), 6.0 * 6.0 ** shape[0] / m.radius[j]
  phase = (2.0 * shape[1] - 1.0) * math.pi
  machine = _gear(m, j, ripple=torque, ripples=periods, ripple_phase=phase)
  return machine, h, {"amplitude": torque, "periods": periods, "phase": phase}


def _payload(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  # On the line to the centre of mass, of the last body.
  place = m.links.centre[j] * (0.8 + 0.6 * shape[0])
  lever = m.links.length.sum() + np.linalg.norm(place)  # of the first joint, about
  mass = m.stall[j] * (0.02 + 0.2 * size) / (GRAVITY * lever)
  load, places = m.links.load.copy(), m.links.place.copy()
  load[j], places[j] = mass, place
  machine = dataclasses.replace(m, links=m.links._replace(load=load, place=places))
  return machine, h, {"mass": mass, "x": place[0], "y": place[1], "z": place[2]}


def _tilt(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  angle = _sign(shape[0]) * (0.03 + 0.2 * size)
  # Axes of chains are along y, and only turns about it are seen.
  along = 2.0 * math.pi * shape[1] if m.plant == "head" else 0.5 * math.pi
  x, y = angle * math.cos(along) if m.plant == "head" else 0.0, angle * math.sin(along)
  gravity = matrix_from_rotvec([x, y, 0.0]) @ m.gravity
  return dataclasses.replace(m, gravity=gravity), h, {"x": x, "y": y}


def _offset(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  offset = _sign(shape[0]) * (0.03 + 0.17 * size)
  return _drive(m, j, offset=offset), h, {"offset": offset}


def _gain(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  gain = 0.88 - 0.48 * size
  if shape[0] < 0.5:  # worn brushes, a thin cable: the winding's circuit resists
    machine = _drive(m, j, resistance=m.drive.resistance[j] / gain)
    return machine, h, {"gain": gain, "scales_limit": 1.0, "scales_damping": 1.0}
  machine = _drive(m, j, proportional=m.drive.proportional[j] * gain)
  return machine, h, {"gain": gain, "position_alone": 1.0}


def _limit(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  duty = 0.65 - 0.35 * size
  return _drive(m, j, most=duty), h, {"limit": duty * m.stall[j]}


def _sag(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  droop = (0.1 + 0.7 * size) / m.stall[0] if shape[0] < 0.7 else 0.0
  fade = 0.003 + 0.017 * size if shape[0] > 0.4 else 0.0
  more = droop * m.supply.voltage * float(m.drive.constant.mean())
  supply = m.supply._replace(resistance=m.supply.resistance + more, fade=fade)
  answer = {"droop": droop, "fade": fade, "scales_limit": 1.0, "back_emf": 1.0}
  return dataclasses.replace(m, supply=supply), h, answer


def _heat(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  heating, cooling = (20.0 + 280.0 * size**2) / m.stall[j] ** 2, 40.0 + 160.0 * shape[0]
  loss = 0.006 + 0.008 * shape[1]
  machine = _drive(m, j, heating=heating, cooling=cooling, foldback=loss)
  answer = {"heating": heating, "time_constant": cooling, "derating": loss}
  return machine, h, {**answer, "scales_limit": 1.0, "back_emf": 1.0}


def _armature(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  factor = 1.5 + 2.5 * size
  return _drive(m, j, rotor=factor * m.drive.rotor[j]), h, {"armature": factor}


def _command_delay(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  delay = 0.005 + 0.05 * size
  return m, h._replace(command_delay=delay), {"delay": delay}


def _reading_delay(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  delay = 0.005 + 0.05 * size
  return m, h._replace(reading_delay=delay), {"delay": delay}


def _clock(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  rate = _sign(shape[0]) * (0.0005 + 0.006 * size)
  return m, h._replace(clock_rate=rate), {"rate": rate}


def _spot(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  of, more = m.ranges[j], m.stall[j] * (0.05 + 0.25 * size)
  width = of.amplitude * (0.1 + 0.1 * shape[1])
  place = of.centre + (shape[0] - 0.5) * of.amplitude
  answer = {"torque": more, "place": place, "width": width}
  return _gear(m, j, spot=more, spot_at=place, spot_width=width), h, answer


def _slip(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  # Of what the link and those beyond it weigh.
  torque = GRAVITY * m.body.moment[j] * (1.3 - size)
  return _drive(_gear(m, j, slip=torque), j, on_rotor=1.0), h, {"torque": torque}


def _stop(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  of, stiffness = m.ranges[j], m.stall[j] * (0.5 + 4.0 * shape[0]) / m.radius[j]
  place = of.centre + of.amplitude * (0.6 - 0.5 * size)
  machine = _gear(m, j, stop=stiffness, stop_at=place)
  return machine, h, {"stiffness": stiffness, "place": place}


def _profile(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  top = m.ranges[j].speed * (0.9 - 0.5 * size)
  ramp = top / (0.02 + 0.08 * shape[0])
  return _drive(m, j, top_speed=top, ramp=ramp), h, {"speed": top, "acceleration": ramp}


def _loose(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  inertia = (0.3 + 1.5 * size) * (m.body.inertia[j, j] + m.drive.rotor[j])
  gap = m.radius[j] * (0.1 + 0.3 * shape[0])
  return _gear(m, j, loose=inertia, loose_gap=gap), h, {"inertia": inertia, "gap": gap}


def _cable(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  reach = (0.15 + 0.25 * shape[0]) * m.radius[j]
  stiffness = m.stall[j] * (0.05 + 0.25 * size) / reach
  machine = _gear(m, j, cable=stiffness, cable_reach=reach)
  return machine, h, {"stiffness": stiffness, "reach": reach}


def _jam(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  factor, when = 2.0 + 4.0 * size, 2.5 + 4.0 * shape[0]
  return _gear(m, j, change=factor, change_at=when), h, {"factor": factor, "time": when}


def _dead_band(m: Machine, h: Host, j: int, size: float, shape: Array) -> Broken:
  band = (0.01 + 0.05 * size) * m.radius[j]
  return _drive(m, j, dead_band=band), h, {"band": band}


_HANGING = ("single", "leg")
_HEAVY = ("single", "head", "leg")
LIBRARY = {
  "coulomb_friction": Kind(_coulomb, "friction"),
  "viscous_friction": Kind(_viscous, "damping"),
  "stribeck_friction": Kind(_stribeck, "friction"),
  "load_friction": Kind(_load, "friction", plants=_HEAVY),
  "asymmetric_friction": Kind(_asymmetric, "friction"),
  "quadratic_drag": Kind(_drag, "damping"),
  "backlash": Kind(_backlash, "play", plants=_HEAVY),
  "payload": Kind(_payload, "weight", plants=_HEAVY),
  "gravity_tilt": Kind(_tilt, "weight", False, _HEAVY),
  "encoder_offset": Kind(_offset, "weight", plants=_HANGING),
  "spring": Kind(_spring, "weight"),
  "cogging": Kind(_cogging, "ripple"),
  "motor_gain": Kind(_gain, "strength"),
  "torque_limit": Kind(_limit, "strength"),
  "supply_sag": Kind(_sag, "strength", False),
  "thermal_derating": Kind(_heat, "strength"),
  "parameter_error": Kind(_armature, "weight"),
  "command_delay": Kind(_command_delay, "time", False),
  "measurement_delay": Kind(_reading_delay, "time", False),
  "clock_drift": Kind(_clock, "time", False),
}
OUTSIDE = {
  "sticky_spot": Kind(_spot, "outside"),
  "slipping_hub": Kind(_slip, "outside", plants=_HANGING),
  "soft_stop": Kind(_stop, "outside"),
  "motion_profile": Kind(_profile, "outside"),
  "loose_mass": Kind(_loose, "outside", plants=("single", "finger")),
  "cable_hysteresis": Kind(_cable, "outside"),
  "sudden_friction": Kind(_jam, "outside"),
  "dead_band": Kind(_dead_band, "outside"),
}
LAST = ("payload",)
"""Kinds that are at the last joint."""
