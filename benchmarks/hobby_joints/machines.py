"""Machines on paper, copies of them, other days, and what is declared of them, as MJCF."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from benchmarks.hobby_joints import bodies, gears
from benchmarks.hobby_joints.bodies import JOINTS, Links
from benchmarks.hobby_joints.gears import Gear
from benchmarks.hobby_joints.servos import Drive, Supply
from nerf2real.core.geometry.rotations import matrix_from_rotvec

Array = np.ndarray
Random = np.random.Generator
PLANTS = tuple(JOINTS)
SERVOS = (
  *((0.5, 9.0, 5.0), (1.5, 6.5, 12.0), (2.7, 7.5, 12.0)),
  *((4.1, 4.8, 12.0), (7.0, 5.5, 14.8), (10.0, 4.0, 14.8)),
)
"""Stall torque N m, speed without load rad/s, supply V: what shops print of common sizes."""
COPIES = {
  **{"constant": 0.015, "resistance": 0.025, "proportional": 0.01, "derivative": 0.02},
  **{"rotor": 0.06, "mass": 0.012, "inertia": 0.02, "dry": 0.18, "rest": 0.2, "of_load": 0.2},
  **{"viscous": 0.3, "rest_speed": 0.2, "reach": 0.2, "stiffness": 0.15},
}
"""What a copy differs by from paper, one standard deviation, cut at 1.5."""
DAYS = {"resistance": 0.008, "constant": 0.003, "dry": 0.06, "viscous": 0.1, "rest": 0.1}
"""From one day to another: temperature, grease."""
_VOLTAGE, _VOLTAGE_DAY = 0.012, 0.006


class Range(NamedTuple):
  """Where a joint moves."""

  centre: float  # rad or m
  amplitude: float
  speed: float  # rad/s or m/s, of the fastest motions


@dataclasses.dataclass(frozen=True)
class Machine:
  """A machine as it is."""

  plant: str
  links: Links
  drive: Drive
  gear: Gear
  supply: Supply
  turn: Array
  """[3, 3], from the base's frame to the world's."""
  radius: Array
  """[n] m that a jaw moves a radian of its servo; 1 for hinges."""
  ranges: tuple[Range, ...]
  gravity: Array
  """[3] m/s^2 in the world."""

  @property
  def joints(self) -> tuple[str, ...]:
    """Their names."""
    return JOINTS[self.plant]

  @property
  def body(self) -> bodies.Body:
    """The equations of motion's coefficients."""
    return bodies.body_of(self.plant, self.links, self.turn, self.gravity)

  @property
  def stall(self) -> Array:
    """Torque at full duty [n] N m or N."""
    return self.drive.constant * self.supply.voltage / self.drive.resistance

  @property
  def back_emf(self) -> Array:
    """Damping of the windings [n] N m s/rad or N s/m."""
    return self.drive.constant**2 / self.drive.resistance


def on_paper(plant: str, random: Random) -> Machine:
  """Returns a machine as it was drawn."""
  n = len(JOINTS[plant])
  first, last = {"leg": (1, len(SERVOS)), "finger": (0, 4)}.get(plant, (0, len(SERVOS)))
  stall, speed, volts = SERVOS[random.integers(first, last)]
  stall, speed = stall * random.uniform(0.9, 1.1), speed * random.uniform(0.9, 1.1)
  radius = random.uniform(0.012, 0.02) if plant == "finger" else 1.0
  force, fast = stall / radius, speed * radius
  derives = random.uniform() < 0.4
  notch = 2.0 * math.pi / (16384 if derives else random.choice([4096, 4096, 16384]))
  gain = 1.0 / (random.uniform(0.12, 0.28) * radius)  # duty per rad
  off = {name: np.zeros(n) for name in Drive._fields}
  far = {name: np.full(n, np.inf) for name in ("top_speed", "ramp")}
  values = {
    "constant": volts / fast,
    "resistance": volts**2 / (force * fast),
    "lag": random.choice([0.0, random.uniform(2e-4, 1e-3)]),
    "rotor": random.uniform(0.012, 0.035) * force / fast,
    "proportional": gain,
    "derivative": gain * random.uniform(0.004, 0.015) if derives else 0.0,
    "smooth": random.uniform(2e-3, 5e-3),
    "most": 1.0,
    "notch": notch * radius,
    "cooling": 300.0,
  }
  drive = Drive(**{**off, **far, **{name: np.full(n, float(v)) for name, v in values.items()}})
  dry, stiffness = random.uniform(0.015, 0.04, n) * force, force / (random.uniform(4e-3, 1e-2))
  gear = gears.healthy(
    n,
    dry=dry,
    rest=dry * random.uniform(0.05, 0.25, n),
    rest_speed=random.uniform(0.02, 0.1, n) * radius,
    reach=random.uniform(2e-4, 8e-4, n) * radius,
    of_load=random.uniform(0.005, 0.03, n),
    viscous=random.uniform(0.03, 0.12, n) * force / fast,
    stiffness=np.full(n, stiffness / radius),
    damping=np.zeros(n),
  )
  links, turn = _links(plant, stall, random), _mount(plant, random)
  least = 0.5 * bodies.body_of(plant, links, turn, np.zeros(3)).inertia.diagonal()
  if plant == "head":
    least = least + 0.5 * links.inertia[1, 1]
  # Teeth as plastic and metal gears have them: a fifth of what would be critical.
  gear = gear._replace(damping=0.4 * np.sqrt(gear.stiffness * np.minimum(least, drive.rotor)))
  centres = {
    "single": [random.uniform(-0.4, 0.4)],
    "head": [random.uniform(-0.3, 0.3), random.uniform(-0.3, 0.3)],
    "leg": [random.uniform(-0.3, 0.3), random.uniform(-0.9, -0.4), random.uniform(-0.2, 0.4)],
    "finger": [random.uniform(1.8, 2.2) * radius],
  }[plant]
  widest = {"single": (0.6, 1.1), "head": (0.4, 0.8), "leg": (0.3, 0.55), "finger": (0.7, 1.3)}
  ranges = tuple(
    Range(centre, radius * random.uniform(*widest[plant]), random.uniform(0.35, 0.6) * fast)
    for centre in centres
  )
  supply = Supply(volts, random.uniform(0.004, 0.015) * volts**2 / (stall * speed), 0.0)
  down = np.array([0.0, 0.0, -bodies.GRAVITY])
  return Machine(plant, links, drive, gear, supply, turn, np.full(n, radius), ranges, down)


def _links(plant: str, stall: float, random: Random) -> Links:
  """Returns links whose weight takes a usual share of the servos' torque."""
  size = 0.1 * stall ** (1.0 / 3.0) * random.uniform(0.8, 1.2)  # m
  if plant == "finger":
    mass = np.array([random.uniform(0.05, 0.2) * stall ** (2.0 / 3.0)])
    return Links(mass, np.zeros((1, 3)), np.full((1, 3), 1e-4), np.zeros(1), *_no_load(1))
  if plant == "head":
    mass = np.array([0.3, random.uniform(0.1, 0.2) * stall / (bodies.GRAVITY * 0.4 * size)])
    centre = np.array([[0.0, 0.0, 0.0], random.uniform([0.2, -0.2, 0.15], [0.4, 0.2, 0.4]) * size])
    round_ = np.array([0.6, 0.5, 0.4]) * size**2
    inertia = mass[:, None] * random.uniform(0.3, 0.8, (2, 1)) * round_
    return Links(mass, centre, inertia, np.array([0.3 * size, 0.0]), *_no_load(2))
  if plant == "single":
    shares, long, weight = np.ones(1), np.zeros(1), random.uniform(0.1, 0.3)
  else:
    shares, long = np.array([1.0, 0.6, 0.2]), size * np.array([1.0, 1.0, 0.0])
    weight = random.uniform(0.2, 0.35)
  middle = size * random.uniform(0.4, 0.6, len(shares)) * (2.0 if plant == "single" else 1.0)
  beyond = shares[::-1].cumsum()[::-1] - shares
  mass = shares * weight * stall / bodies.GRAVITY / np.sum(shares * middle + long * beyond)
  centre = np.stack([0.0 * middle, 0.0 * middle, -middle], 1)
  inertia = (mass * middle**2)[:, None] * np.array([0.35, 0.35, 0.1])
  return Links(mass, centre, inertia, long, *_no_load(len(shares)))


def _no_load(n: int) -> tuple[Array, Array]:
  return np.zeros(n), np.zeros((n, 3))


def _mount(plant: str, random: Random) -> Array:
  """Returns how the base stands: [3, 3] to the world."""
  lean, angle = random.choice([0.0, random.uniform(-0.8, 0.8)]), random.uniform(-1.2, 1.2)
  if plant == "single":
    return matrix_from_rotvec([lean, 0.0, 0.0]) @ matrix_from_rotvec([0.0, angle, 0.0])
  return matrix_from_rotvec([0.0, angle, 0.0]) if plant == "finger" else np.eye(3)


def copy_of(machine: Machine, random: Random, shares: dict[str, float] = COPIES) -> Machine:
  """Returns a machine as built, or with DAYS as it is on another day."""
  parts: dict[str, Any] = {"links": machine.links, "drive": machine.drive, "gear": machine.gear}
  for name, share in shares.items():
    for key, part in parts.items():
      if name in part._fields:
        value = getattr(part, name)
        off = np.clip(random.standard_normal(len(value)), -1.5, 1.5) * share
        off = off[:, None] if value.ndim == 2 else off
        parts[key] = part._replace(**{name: value * (1.0 + off)})
  share = _VOLTAGE if shares is COPIES else _VOLTAGE_DAY
  volts = machine.supply.voltage * (1.0 + share * np.clip(random.standard_normal(), -1.5, 1.5))
  return dataclasses.replace(machine, supply=machine.supply._replace(voltage=float(volts)), **parts)


def declared(machine: Machine) -> str:
  """Returns the MJCF that data sheets and CAD give for a machine."""
  drive, gear, links = machine.drive, machine.gear, machine.links
  form = bodies.FORMS[machine.plant]
  stiffness, rate = machine.stall * drive.proportional, machine.stall * drive.derivative
  damping = machine.back_emf + gear.viscous
  opened, closed, actuators = "", "", ""
  for j, joint in enumerate(machine.joints):
    axis = "1 0 0" if form == bodies.RAIL else "0 1 0"
    place = "0 0 0"
    if form == bodies.HEAD:
      axis = ("0 0 1", "0 1 0")[j]
      place = ("0 0 0", f"{links.length[0]:.5g} 0 0.03")[j]
    elif j:
      place = f"0 0 {-links.length[j - 1]:.5g}"
    opened += f"""
      <body name="{joint}_link" pos="{place}">
        <joint name="{joint}" type="{"slide" if form == bodies.RAIL else "hinge"}" axis="{axis}"
          damping="{damping[j]:.5g}" armature="{drive.rotor[j]:.5g}"
          frictionloss="{gear.dry[j]:.5g}"/>
        <inertial pos="{_words(links.centre[j])}" mass="{links.mass[j]:.5g}"
          diaginertia="{_words(links.inertia[j])}"/>"""
    closed += "</body>"
    actuators += f"""
    <position name="{joint}" joint="{joint}" kp="{stiffness[j]:.5g}" kv="{rate[j]:.5g}"
      forcerange="{-machine.stall[j]:.5g} {machine.stall[j]:.5g}"/>"""
  return f"""<mujoco model="{machine.plant}">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="base" pos="0 0 0.5" xyaxes="{_words(machine.turn[:, :2].T.ravel())}">{opened}
    {closed}</body>
  </worldbody>
  <actuator>{actuators}
  </actuator>
</mujoco>
"""


def _words(values: Array) -> str:
  return " ".join(f"{value:.6g}" for value in values)
