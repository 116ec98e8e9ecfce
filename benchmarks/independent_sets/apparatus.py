"""Draws machines on paper: their constants and the declared MuJoCo model of them.

- "slider": carriage on a ball screw, cascaded position and velocity loop;
- "arm": two links in a vertical plane on strain-wave gears, torque (current) commands at 250 Hz;
- "wheel": disc with an eccentric load on a hobby servo, or a weight on a rod.

Ranges are those of catalogues of such parts (screws of 5 to 20 mm lead, motors of 30 to 400 W,
strain-wave gears of 50 to 120, hobby servos of 1.5 to 8 N m).
"""

import dataclasses

import numpy as np

from benchmarks.independent_sets.machine import Machine

KINDS = ("slider", "arm", "wheel")
SHARES = (0.3, 0.3, 0.4)
GRAVITY = 9.81


@dataclasses.dataclass(frozen=True)
class Apparatus:
  """A machine on paper."""

  plant: str
  mode: str
  """Of `drives.Drive`."""
  nominal: Machine
  joints: tuple[str, ...]
  bodies: tuple[str, ...]
  xml: str
  center: np.ndarray
  """[n] rad or m about which it moves."""
  amplitude: np.ndarray
  """[n]."""
  speed: float
  """rad/s or m/s of slow travel."""
  drive_rate: int
  """Hz of the controllers."""
  command_period: float
  """s."""


def make_apparatus(plant: str, rng: np.random.Generator) -> Apparatus:
  """Returns a machine of a kind, drawn."""
  return {"slider": _slider, "arm": _arm, "wheel": _wheel}[plant](rng)


def _machine(joints: int, **values: float | np.ndarray) -> Machine:
  """Returns constants as arrays, of one machine; what is not given is absent."""
  absent = dict.fromkeys((f.name for f in dataclasses.fields(Machine) if f.name != "slides"), 0.0)
  absent |= {"gravity": GRAVITY, "dwell_time": 1.0, "patch_width": 1.0, "drift_time": 1.0}
  absent |= {"stribeck_speed": 1.0, "fall_speed": 1.0, "spring_begins": 1e9, "duty_limit": 1.0}
  absent |= {"current_time": 1.0, "rate_filter": 1.0, "length": 1.0, "velocity_gain": 1.0}
  shared = ("gravity", "tilt", "length", "volts", "fade", "command_delay", "measurement_delay")
  slides = bool(values.pop("slides", False))
  arrays = {}
  for name, value in (absent | values).items():
    size = 1 if name in shared else joints
    arrays[name] = np.broadcast_to(np.asarray(value, float), (size,)).copy()
  return Machine(**arrays, slides=slides)


def _slider(rng: np.random.Generator) -> Apparatus:
  carriage = rng.uniform(4.0, 15.0)
  lead = rng.choice([5e-3, 10e-3, 16e-3, 20e-3])
  per_turn = lead / (2 * np.pi)  # m/rad
  constant = rng.uniform(0.08, 0.16) / per_turn  # N/A
  rotor = rng.uniform(0.25, 0.9) * carriage
  total = carriage + rotor
  slope = rng.choice([0.0, rng.uniform(0.1, 0.8)])
  velocity_gain = total * rng.uniform(50.0, 90.0)
  position_gain = rng.uniform(15.0, 28.0)
  most = total * rng.uniform(7.0, 13.0) + carriage * GRAVITY * np.sin(slope)
  coulomb = total * rng.uniform(0.5, 1.4)
  viscous = total * rng.uniform(0.5, 2.0)
  stiffness = rotor * carriage / total * (2 * np.pi * rng.uniform(50.0, 90.0)) ** 2
  nominal = _machine(
    1,
    slides=True,
    mass=carriage,
    tilt=slope,
    rotor=rotor,
    gear_stiffness=stiffness,
    gear_damping=0.1 * np.sqrt(stiffness * rotor * carriage / total),
    viscous=viscous,
    coulomb=coulomb,
    presliding=rng.uniform(8e-6, 3e-5),
    fall=rng.uniform(0.03, 0.12),
    fall_speed=rng.uniform(0.003, 0.01),
    torque_constant=constant,
    nominal_constant=constant,
    resistance=rng.uniform(0.5, 1.2),
    inductance=rng.uniform(0.6e-3, 2e-3),
    # Enough for the largest current at 1 m/s.
    volts=1.4 * (constant * 1.0 + 1.2 * most / constant),
    current_limit=most / constant,
    current_time=rng.uniform(3e-4, 8e-4),
    position_gain=position_gain,
    velocity_gain=velocity_gain,
    rate_filter=rng.uniform(5e-4, 1.5e-3),
    count=rng.choice([1e-6, 5e-6, lead / 10000]),
  )
  axis = f"{np.cos(slope):.9f} 0 {np.sin(slope):.9f}"
  joint = f"""<joint name="axis" type="slide" axis="{axis}" {_losses(nominal, 0)}/>
      <inertial pos="0 0 0" mass="{carriage:.9g}" diaginertia="0.01 0.01 0.01"/>"""
  actuator = f"""<position name="axis" joint="axis" kp="{velocity_gain * position_gain:.9g}"
      kv="{velocity_gain:.9g}" forcerange="{-most:.9g} {most:.9g}"/>"""
  xml = _mjcf("slider", f'<body name="carriage">{joint}</body>', actuator)
  reach = rng.uniform(0.05, 0.14)
  period = float(rng.choice([0.004, 0.008, 0.01]))
  return Apparatus(
    "slider",
    "cascade",
    nominal,
    ("axis",),
    ("carriage",),
    xml,
    np.zeros(1),
    np.array([reach]),
    0.4 * reach,
    int(rng.choice([1000, 2500])),
    period,
  )


def _arm(rng: np.random.Generator) -> Apparatus:
  lengths = rng.uniform(0.22, 0.38, 2)
  masses = np.array([rng.uniform(1.5, 3.0), rng.uniform(0.7, 1.8)])
  centers = lengths * rng.uniform(0.4, 0.6, 2)
  turning = masses * lengths**2 * rng.uniform(0.07, 0.1, 2)  # about their centres
  load = GRAVITY * (masses[0] * centers[0] + masses[1] * (lengths[0] + centers[1]))
  most = np.array([1.0, 0.4]) * load * rng.uniform(2.2, 3.2)
  inertia = turning + masses * centers**2
  rotor = inertia.sum() * np.array([rng.uniform(0.2, 0.5), rng.uniform(0.08, 0.2)])
  constant = most / rng.uniform(5.0, 9.0, 2)
  lighter = np.minimum(rotor, inertia)
  stiffness = lighter * (2 * np.pi * rng.uniform(35.0, 60.0)) ** 2
  nominal = _machine(
    2,
    mass=masses,
    inertia=inertia,
    moment_z=-masses * centers,
    length=lengths[0],
    rotor=rotor,
    gear_stiffness=stiffness,
    gear_damping=0.1 * np.sqrt(stiffness * lighter),
    viscous=most * rng.uniform(0.008, 0.03, 2),
    coulomb=most * rng.uniform(0.015, 0.05, 2),
    presliding=rng.uniform(2e-4, 8e-4, 2),
    fall=rng.uniform(0.03, 0.15, 2),
    fall_speed=rng.uniform(0.02, 0.1, 2),
    torque_constant=constant,
    nominal_constant=constant,
    resistance=rng.uniform(0.4, 1.0, 2),
    inductance=rng.uniform(0.2e-3, 0.8e-3, 2),
    volts=1.5 * float(np.max(constant * 4.0 + 1.0 * most / constant)),
    current_limit=most / constant,
    current_time=rng.uniform(2e-4, 6e-4),
    count=2 * np.pi / rng.choice([2**15, 2**17]),
  )
  upper, lower = (_link(nominal, i, turning[i]) for i in range(2))
  tree = f"""<body name="upper">
      <joint name="shoulder" axis="0 1 0" {_losses(nominal, 0)}/>{upper}
      <body name="lower" pos="0 0 {-lengths[0]:.9g}">
        <joint name="elbow" axis="0 1 0" {_losses(nominal, 1)}/>{lower}
      </body>
    </body>"""
  actuators = "\n    ".join(
    f'<motor name="{name}" joint="{name}" forcerange="{-top:.9g} {top:.9g}"/>'
    for name, top in zip(("shoulder", "elbow"), most, strict=True)
  )
  return Apparatus(
    "arm",
    "current",
    nominal,
    ("shoulder", "elbow"),
    ("upper", "lower"),
    _mjcf("two_link_arm", tree, actuators),
    rng.uniform(-0.4, 0.4, 2),
    rng.uniform(0.5, 0.9, 2),
    0.3,
    1000,
    0.004,
  )


def _wheel(rng: np.random.Generator) -> Apparatus:
  stall = float(np.exp(rng.uniform(np.log(1.5), np.log(8.0))))
  volts = float(rng.choice([7.4, 12.0, 24.0]))
  no_load = rng.uniform(4.5, 7.0)  # rad/s
  constant = volts / no_load  # V s/rad, N m/A
  resistance = constant * volts / stall
  stiff = stall / rng.uniform(0.15, 0.3)  # N m/rad
  disc = rng.random() < 0.5
  load = stall * rng.uniform(0.1, 0.3) / GRAVITY  # kg m
  radius = rng.uniform(0.07, 0.15)
  weight = load / radius
  side = radius * rng.uniform(-0.3, 0.3) if disc else 0.0
  turning = (rng.uniform(0.6, 2.0) if disc else 0.08) * weight * radius**2  # about its centre
  inertia = turning + weight * (radius**2 + side**2)
  rotor = stiff * rng.uniform(1.2e-3, 2.5e-3)
  stiffness = min(rotor, inertia) * (2 * np.pi * rng.uniform(40.0, 75.0)) ** 2
  nominal = _machine(
    1,
    mass=weight,
    inertia=inertia,
    moment_x=weight * side,
    moment_z=-load,
    rotor=rotor,
    gear_stiffness=stiffness,
    gear_damping=0.1 * np.sqrt(stiffness * min(rotor, inertia)),
    viscous=stall * rng.uniform(0.002, 0.01),
    coulomb=stall * rng.uniform(0.01, 0.03),
    presliding=rng.uniform(3e-4, 1e-3),
    fall=rng.uniform(0.03, 0.15),
    fall_speed=rng.uniform(0.05, 0.2),
    torque_constant=constant,
    nominal_constant=constant,
    resistance=resistance,
    inductance=resistance * rng.uniform(2e-4, 6e-4),
    volts=volts,
    current_limit=1e3,
    dead_band=rng.uniform(0.001, 0.006),
    servo_gain=stiff / stall,
    count=2 * np.pi / rng.choice([4096, 16384]),
  )
  place, moments = f"{side:.9g} 0 {-radius:.9g}", " ".join(3 * [f"{turning:.9g}"])
  name = "wheel" if disc else "rod"
  joint = f"""<joint name="hub" axis="0 1 0"
        {_losses(nominal, 0, extra=constant**2 / resistance)}/>
      <inertial pos="{place}" mass="{weight:.9g}" diaginertia="{moments}"/>"""
  actuator = f"""<position name="hub" joint="hub" kp="{stiff:.9g}"
      forcerange="{-stall:.9g} {stall:.9g}"/>"""
  return Apparatus(
    "wheel",
    "servo",
    nominal,
    ("hub",),
    (name,),
    _mjcf(name, f'<body name="{name}">{joint}</body>', actuator),
    rng.uniform(-0.3, 0.3, 1),
    rng.uniform(0.6, 1.1, 1),
    0.4,
    1000,
    float(rng.choice([0.01, 0.02])),
  )


def _losses(nominal: Machine, joint: int, *, extra: float = 0.0) -> str:
  """Returns a joint's damping, dry friction and armature as attributes."""
  return (
    f'damping="{nominal.viscous[joint] + extra:.9g}" '
    f'frictionloss="{nominal.coulomb[joint]:.9g}" armature="{nominal.rotor[joint]:.9g}"'
  )


def _link(nominal: Machine, joint: int, turning: float) -> str:
  """Returns a link's `inertial`."""
  center = nominal.moment_z[joint] / nominal.mass[joint]
  moments = f"{turning:.9g} {turning:.9g} {0.1 * turning:.9g}"
  return f"""
      <inertial pos="0 0 {center:.9g}" mass="{nominal.mass[joint]:.9g}" diaginertia="{moments}"/>"""


def _mjcf(name: str, bodies: str, actuators: str) -> str:
  return f"""<mujoco model="{name}">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    {bodies}
  </worldbody>
  <actuator>
    {actuators}
  </actuator>
</mujoco>
"""
