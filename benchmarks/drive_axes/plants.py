"""Machines: what is drawn of them, how copies and days differ, and what an engineer declares."""

import dataclasses
import math

import numpy as np

from benchmarks.drive_axes import mechanics, motions
from benchmarks.drive_axes.mechanics import Links
from benchmarks.drive_axes.simulation import Axes

Random = np.random.Generator
PLANTS = ("lift", "swing", "planar")
JOINTS = {"lift": ("carriage",), "swing": ("swivel",), "planar": ("shoulder", "elbow")}
TOLERANCES = {"dry": 0.25, "rotor": 0.10, "viscous": 0.20}
"""Largest share by which a declared constant is off; chosen: bearings' and gears' datasheets state
friction to a quarter, rotors' inertia to a tenth."""
MASS_TOLERANCE = 0.02
COPIES = {
  **{"dry": 0.08, "breakaway": 0.15, "viscous": 0.06, "rotor": 0.02, "gain": 0.01, "lag": 0.1},
  **{"stiffness": 0.05, "error": 0.3, "presliding": 0.1},
}
"""Standard deviations by which copies of a machine differ, as shares; chosen."""
DAYS = {"dry": 0.05, "breakaway": 0.05, "viscous": 0.04, "gain": 0.003, "presliding": 0.05}
"""The same of one machine from day to day; chosen."""
FAR = 1e12


@dataclasses.dataclass(frozen=True)
class Machine:
  """One machine, with all that is wrong with it."""

  plant: str
  axes: Axes
  links: Links
  reach: tuple[motions.Reach, ...]
  """What its motions may ask, by joint."""

  @property
  def joints(self) -> tuple[str, ...]:
    """Names of its joints."""
    return JOINTS[self.plant]


def change(axes: Axes, joint: int, **values: float) -> Axes:
  """Returns constants of which one joint's are others."""
  new = {name: getattr(axes, name).copy() for name in values}
  for name, value in values.items():
    new[name][joint] = value
  return axes._replace(**new)


def on_paper(plant: str, random: Random) -> Machine:
  """Returns a machine as designed."""
  u = random.uniform
  if plant == "lift":  # a ball screw
    links = _links(mass=[u(3.0, 7.0)], centre=[0.0], inertia=[0.0], length=[0.0])
    rotor, acceleration = [u(5.0, 10.0)], [u(3.0, 4.0)]
    reach = [motions.Reach(u(0.15, 0.22), u(0.45, 0.7), acceleration[0])]
    loop, stiffness = (u(12.0, 16.0), u(45.0, 65.0)), [u(2e6, 5e6)]
    waves, error = [math.tau / random.choice([0.01, 0.016, 0.02])], [u(2e-6, 8e-6)]
    resolution, noise, fall, presliding = [1e-5], [4e-6], u(0.008, 0.03), u(1e-5, 4e-5)
  elif plant == "swing":  # a harmonic drive: its error has two periods a turn of the motor
    mass, length = np.array([u(2.5, 5.0)]), np.array([u(0.4, 0.6)])
    links = _links(mass, 0.5 * length, mass * length**2 / 12.0, length)
    rotor, acceleration = [u(0.15, 0.4)], [u(9.0, 13.0)]
    reach = [motions.Reach(u(0.7, 1.0), u(1.6, 2.4), acceleration[0])]
    loop, stiffness = (u(7.0, 10.0), u(20.0, 32.0)), [u(4e3, 9e3)]
    waves, error = [2.0 * random.choice([50.0, 80.0, 100.0])], [u(1e-4, 3e-4)]
    resolution, noise, fall, presliding = [math.tau / 2**17], [3e-5], u(0.03, 0.1), u(2e-4, 6e-4)
  else:  # belts
    mass, length = np.array([u(2.0, 3.2), u(0.9, 1.6)]), np.array([u(0.26, 0.34), u(0.22, 0.3)])
    centre = length * [u(0.3, 0.42), u(0.4, 0.5)]
    links = _links(mass, centre, mass * length**2 / 12.0, length)
    rotor, acceleration = [u(0.2, 0.35), u(0.03, 0.06)], [u(7.0, 10.0), u(9.0, 13.0)]
    reach = [motions.Reach(u(0.55, 0.8), u(1.4, 2.0), a) for a in acceleration]
    loop, stiffness = (u(9.0, 12.0), u(30.0, 45.0)), [u(3e3, 6e3), u(7e2, 1.4e3)]
    waves, error = [u(5.0, 9.0), u(5.0, 9.0)], [u(2e-4, 6e-4), u(2e-4, 6e-4)]  # of pulleys
    resolution, noise, fall, presliding = 2 * [math.tau / 2**16], 2 * [4e-5], 0.08, u(3e-4, 8e-4)
  inertia = _inertia(plant, links)
  weight = _weight(plant, links)
  whole, n = inertia + rotor, len(rotor)
  needed = weight + whole * acceleration
  meeting = inertia * rotor / whole
  ones = np.ones(n)
  zeros = dict.fromkeys(Axes._fields, 0.0)
  shares = random.uniform([0.12, 0.03, 0.01], [0.25, 0.08, 0.04], (n, 3)).T
  if plant == "swing":  # harmonic drives rub most
    shares[0] *= 1.7
  stiff = np.array(stiffness)
  speed_gain = whole * loop[1]
  set_values = {
    "position_gain": loop[0],
    "speed_gain": speed_gain,
    "integral_time": u(1.5, 3.0) * (2.0 if plant == "lift" else 1.0),
    "leak": u(0.3, 0.7),
    "most_speed": [1.5 * r.speed for r in reach],
    "most_slope": [6.0 * a for a in acceleration],
    "limit": needed * u(1.4, 1.9),
    "filter_time": u(3e-4, 1e-3),
    "encoder_step": resolution,
    "encoder_noise": noise,
    "lag": u(4e-4, 1.5e-3),
    "gain": 1.0,
    "rotor": rotor,
    "viscous": shares[1] * speed_gain,
    "dry": shares[0] * needed,
    "breakaway": shares[0] * needed * u(0.2, 0.6),
    "fall": fall,
    "presliding": presliding,
    "of_load": shares[2],
    "stiffness": stiff,
    "damping": 2.0 * u(0.03, 0.06) * np.sqrt(stiff * meeting),
    "error": error,
    "error_waves": waves,
  }
  unused = ("more_fall", "warming", "spot_width", "slips_at", "cable_at", "brake_period")
  values = zeros | dict.fromkeys(unused, FAR) | set_values
  axes = Axes(**{name: ones * np.asarray(value, float) for name, value in values.items()})
  return Machine(plant, axes, links, tuple(reach))


def _links(mass: object, centre: object, inertia: object, length: object) -> Links:
  m, c, i, r = (np.asarray(value, float) for value in (mass, centre, inertia, length))
  return Links(m, c, i, r, np.zeros_like(m), np.zeros_like(m), np.zeros(2))


def _inertia(plant: str, links: Links) -> np.ndarray:
  """Returns what each motor moves of links that are stretched, kg m^2 or kg."""
  of = mechanics.coefficients(plant, links)
  return np.array([of.a1 + 2.0 * of.a2, of.a3][: links.mass.size])


def _weight(plant: str, links: Links) -> np.ndarray:
  """Returns the largest torque of gravity at each joint, N m or N."""
  of = mechanics.coefficients(plant, links)
  pull = math.hypot(of.along, of.across)
  return np.array([abs(of.constant) + (of.m1 + of.m2) * pull, of.m2 * pull][: links.mass.size])


def copy_of(machine: Machine, random: Random, spread: dict[str, float] = COPIES) -> Machine:
  """Returns a machine whose constants differ from another's by shares (COPIES or DAYS)."""
  new = {}
  for name, share in spread.items():
    value = getattr(machine.axes, name)
    new[name] = value * (1.0 + share * np.clip(random.standard_normal(value.size), -2.5, 2.5))
  return dataclasses.replace(machine, axes=machine.axes._replace(**new))


def as_declared(machine: Machine, random: Random) -> Machine:
  """Returns what an engineer takes a machine for."""
  axes = machine.axes
  new = {
    name: getattr(axes, name) * (1.0 + random.uniform(-off, off, axes.gain.size))
    for name, off in TOLERANCES.items()
  }
  factor = 1.0 + random.uniform(-MASS_TOLERANCE, MASS_TOLERANCE, axes.gain.size)
  links = machine.links
  links = links._replace(mass=links.mass * factor, inertia=links.inertia * factor)
  axes = axes._replace(gain=np.ones_like(axes.gain), **new)
  return dataclasses.replace(machine, axes=axes, links=links)


def declared(machine: Machine) -> str:
  """Returns the MJCF of a machine: the cascade without its integral, rigid transmissions.

  Kv (Kp (goal - q) - v) is a position actuator of kp = Kp Kv and kv = Kv.
  """
  axes, links = machine.axes, machine.links
  bodies, ends, actuators = "", "", ""
  for j, name in enumerate(machine.joints):
    if machine.plant == "lift":
      kind, axis, along = "slide", "0 0 1", np.array([0.0, 0.0, 0.0])
    elif machine.plant == "swing":
      kind, axis, along = "hinge", "0 0 1", np.array([1.0, 0.0, 0.0])
    else:
      kind, axis, along = "hinge", "0 1 0", np.array([0.0, 0.0, -1.0])
    start = along * links.length[j - 1] if j else np.array([0.0, 0.0, 1.0])
    about = max(float(links.inertia[j]), 1e-4)
    # Only the moment about the joint's axis is ever used: all three are that one.
    moments = " ".join(f"{about:.6g}" for _ in range(3))
    bodies += f"""
    <body name="{name}_link" pos="{_text(start)}">
      <joint name="{name}" type="{kind}" axis="{axis}" damping="{axes.viscous[j]:.6g}"
        armature="{axes.rotor[j]:.6g}" frictionloss="{axes.dry[j]:.6g}"/>
      <inertial pos="{_text(along * links.centre[j])}" mass="{links.mass[j]:.6g}"
        diaginertia="{moments}"/>"""
    ends += "</body>"
    gain = axes.gain[j] * axes.speed_gain[j]
    limit = axes.gain[j] * axes.limit[j]
    actuators += f"""
    <position name="{name}" joint="{name}" kp="{gain * axes.position_gain[j]:.6g}"
      kv="{gain:.6g}" forcerange="{-limit:.6g} {limit:.6g}"/>"""
  return f"""<mujoco model="{machine.plant}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>{bodies}
    {ends}
  </worldbody>
  <actuator>{actuators}
  </actuator>
</mujoco>
"""


def _text(vector: np.ndarray) -> str:
  return " ".join(f"{value:.6g}" for value in vector)
