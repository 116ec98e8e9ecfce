"""Servos and arms on paper, their declared MJCF, and how copies and days differ from paper."""

import math
from typing import NamedTuple

import numpy as np

from benchmarks.servo_bench import arm, friction, gear, loop, motor
from benchmarks.servo_bench.simulation import Bench

Random = np.random.Generator

JOINT, BODY = "shaft", "arm"
GRAVITY = 9.81
"""m/s^2."""
PLANTS = ("hanging", "bent", "level", "turntable")
"""Where the arm's mass is at angle 0: below, obliquely below, beside; or on a vertical axis."""


class Catalogue(NamedTuple):
  """What a maker prints of a servo."""

  voltage: float
  """V."""
  stall: float
  """N m, at full duty."""
  speed: float
  """rad/s, without load."""
  rotor: float
  """kg m^2, seen from the output; not printed, from the time to full speed: 25 to 55 ms."""
  counts: int
  """A turn."""
  steps: int
  """Of full duty."""


SERVOS = (
  Catalogue(5.0, 0.50, 10.8, 0.0018, 4096, 885),
  Catalogue(7.4, 1.5, 7.5, 0.006, 4096, 1000),
  Catalogue(7.4, 1.9, 5.4, 0.014, 4096, 1000),
  Catalogue(12.0, 4.1, 4.8, 0.040, 4096, 885),
  Catalogue(14.8, 8.5, 5.6, 0.060, 16384, 1023),
)
"""From small toys' servos to those of a small humanoid's legs; figures of their classes."""


class Paper(NamedTuple):
  """A type of servo with an arm: what all copies of it are scattered about."""

  plant: str
  servo: Catalogue
  mass: float
  """kg, of the arm."""
  radius: float
  """m, from the axis to its centre of mass."""
  direction: float
  """rad, of the centre of mass in the plane of `arm`."""
  bench: Bench
  read: Bench
  """What a reader of the datasheet takes for it: round guesses of what is not printed."""


def between(low: float, high: float, share: float) -> float:
  """Returns the value at a share of the way from low to high, in equal ratios."""
  return low * (high / low) ** share


def on_paper(plant: str, random: Random) -> Paper:
  """Returns a servo with an arm and a gain that suits both."""
  servo = SERVOS[random.integers(len(SERVOS))]
  constant = servo.voltage / servo.speed
  damping = servo.stall / servo.speed
  turn = {"hanging": math.pi, "level": math.pi / 2, "turntable": random.uniform(-3.0, 3.0)}
  bend = math.copysign(random.uniform(0.4, 1.1), random.uniform(-1, 1))
  direction = turn.get(plant, math.pi + bend)
  radius = random.uniform(0.08, 0.22)
  mass = between(0.06, 0.35, random.uniform()) * servo.stall / (GRAVITY * radius)
  spread = random.uniform(0.2, 0.5)
  rotor = servo.rotor * between(0.6, 1.6, random.uniform())
  inertia = mass * radius**2 * (1.0 + spread**2)
  viscous = damping * random.uniform(0.03, 0.12)
  hard = random.uniform() < 0.5
  saturating = between(*((0.06, 0.13) if hard else (0.2, 0.45)), random.uniform())  # rad
  # Some owners bear a servo that rings, and leave its rate gain at the maker's zero.
  borne = random.choice([0.3, 0.65])
  firmware = _gains(servo, saturating, rotor + inertia, damping + viscous, borne)
  coulomb = servo.stall * between(0.012, 0.035, random.uniform())
  bristles = coulomb / random.uniform(8e-4, 2.5e-3)
  tooth = servo.stall / random.uniform(4e-3, 10e-3)
  lighter = rotor * inertia / (rotor + inertia)
  bench = Bench(
    motor.Motor(
      constant=constant,
      resistance=constant * servo.voltage / servo.stall,
      voltage=servo.voltage,
      source_resistance=0.0,
      fade=0.0,
      # At a stall a healthy winding warms by some kelvin a second.
      heat_capacity=servo.stall * servo.speed / random.uniform(1.0, 3.0),
      cooling_time=random.uniform(30.0, 90.0),
      derating=0.0,
      forward=1.0,
    ),
    friction.Friction(
      coulomb=coulomb,
      positive=0.0,
      negative=0.0,
      breakaway=coulomb * random.uniform(0.08, 0.3),
      stribeck_speed=random.uniform(0.05, 0.2),
      viscous=viscous,
      load=random.uniform(0.02, 0.07),
      stiffness=bristles,
      damping=random.uniform(0.2, 0.8) * math.sqrt(bristles * rotor),
      cold=0.0,
      warming_time=1.0,
      patch=0.0,
      patch_angle=0.0,
      patch_width=1.0,
    ),
    gear.Gear(
      rotor=rotor,
      play=random.uniform(0.8e-3, 3e-3),
      stiffness=tooth,
      damping=random.uniform(0.2, 0.5) * math.sqrt(tooth * lighter),
    ),
    firmware._replace(noise=random.uniform(0.1, 0.4), dead_band=int(random.integers(0, 3))),
    arm.Arm(
      inertia=inertia,
      moment_1=mass * radius * math.cos(direction),
      moment_2=mass * radius * math.sin(direction),
      gravity_1=0.0 if plant == "turntable" else -GRAVITY,
      gravity_2=0.0,
      spring=0.0,
      spring_angle=0.0,
      stop=0.0,
      stop_angle=0.0,
      drag=0.0,
      ripple=servo.stall * random.uniform(0.001, 0.004),
      ripple_periods=random.uniform(15.0, 40.0),
      ripple_phase=random.uniform(-math.pi, math.pi),
      cable=0.0,
      cable_slip=0.1,
      tip_share=0.0,
      tip_frequency=30.0,
      tip_damping=0.03,
    ),
  )
  read = bench._replace(
    friction=bench.friction._replace(coulomb=_off(coulomb, 0.25, random), viscous=0.0),
    gear=bench.gear._replace(rotor=_off(rotor, 0.1, random)),
  )
  return Paper(plant, servo, mass, radius, direction, bench, read)


def _gains(
  servo: Catalogue, saturating: float, inertia: float, damping: float, borne: float
) -> loop.Loop:
  """Returns a P loop that saturates at an error [rad]; PD below a damping ratio that is borne."""
  firmware = loop.Loop(
    counts=servo.counts,
    gain=round(loop.DENOMINATOR * servo.steps * math.tau / servo.counts / saturating),
    rate_gain=0,
    steps=servo.steps,
    limit=servo.steps,
    dead_band=0,
    slew=math.inf,
    offset=0.0,
    noise=0.0,
  )
  missing = 2.0 * borne * math.sqrt(servo.stall / saturating * inertia) - damping
  one = loop.speed_gain(firmware._replace(rate_gain=1), servo.stall)
  return firmware._replace(rate_gain=max(round(missing / one), 0))


def _off(value: float, share: float, random: Random) -> float:
  """Returns a value that is off by a normal draw, of two and a half deviations at most."""
  return value * (1.0 + share * float(np.clip(random.standard_normal(), -2.5, 2.5)))


def copy_of(paper: Paper, random: Random) -> Bench:
  """Returns one copy of a bench: makers' tolerances, as they are before any effect."""
  m, f, g, _, a = paper.bench
  length, mass = _off(1.0, 0.005, random), _off(1.0, 0.01, random)
  level = 0.002 * random.standard_normal(2)
  return paper.bench._replace(
    motor=m._replace(
      constant=_off(m.constant, 0.02, random),
      # Printed stall torques are without the bridge and the leads.
      resistance=_off(m.resistance, 0.04, random) * random.uniform(1.0, 1.06),
      voltage=_off(m.voltage, 0.007, random),
      source_resistance=m.resistance * random.uniform(0.005, 0.02),
    ),
    friction=f._replace(
      coulomb=_off(f.coulomb, 0.2, random),
      viscous=_off(f.viscous, 0.2, random),
    ),
    gear=g._replace(rotor=_off(g.rotor, 0.03, random)),
    loop=paper.bench.loop._replace(offset=0.002 * random.standard_normal()),
    arm=a._replace(
      inertia=a.inertia * mass * length**2,
      moment_1=a.moment_1 * mass * length,
      moment_2=a.moment_2 * mass * length,
      gravity_1=a.gravity_1 + GRAVITY * level[0] * (paper.plant == "turntable"),
      gravity_2=a.gravity_2 + GRAVITY * level[1],
    ),
  )


def another_day(bench: Bench, random: Random) -> Bench:
  """Returns the same copy on another day: the room's temperature, grease, supply's setting."""
  m, f = bench.motor, bench.friction
  return bench._replace(
    motor=m._replace(
      resistance=_off(m.resistance, 0.006, random), voltage=_off(m.voltage, 0.002, random)
    ),
    friction=f._replace(
      coulomb=_off(f.coulomb, 0.05, random), viscous=_off(f.viscous, 0.05, random)
    ),
    loop=bench.loop._replace(offset=bench.loop.offset + 3e-4 * random.standard_normal()),
  )


def declared(paper: Paper, bench: Bench | None = None) -> str:
  """Returns the MJCF that a reader of the datasheet writes; with a bench, of its true constants."""
  m, f, g, firmware, a = bench or paper.read
  stall = motor.stall_torque(m)
  upright = paper.plant != "turntable"
  # Moments and their perpendicular axis: the plane is (z, x) about y, or (x, y) about z.
  heaviness = math.hypot(a.moment_1, a.moment_2) / paper.mass
  place = heaviness * np.array([math.cos(paper.direction), math.sin(paper.direction)])
  x, y, z = (place[1], 0.0, place[0]) if upright else (place[0], place[1], 0.0)
  inertia = max(a.inertia - paper.mass * heaviness**2, 1e-7)
  rate = loop.speed_gain(firmware, stall)
  kv = f' kv="{rate:.5g}"' if rate else ""
  limit = stall * firmware.limit / firmware.steps
  damping = m.constant**2 / m.resistance + f.viscous
  return f"""<mujoco model="servo_bench_{paper.plant}">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="{BODY}" pos="0 0 0.6">
      <joint name="{JOINT}" type="hinge" axis="{"0 1 0" if upright else "0 0 1"}"
        damping="{damping:.5g}" armature="{g.rotor:.4g}" frictionloss="{f.coulomb:.4g}"/>
      <inertial pos="{x:.6g} {y:.6g} {z:.6g}" mass="{paper.mass:.5g}"
        diaginertia="{inertia:.5g} {inertia:.5g} {inertia:.5g}"/>
      <geom type="capsule" fromto="0 0 0 {x:.6g} {y:.6g} {z:.6g}" size="0.008" contype="0"
        conaffinity="0" mass="0"/>
    </body>
  </worldbody>
  <actuator>
    <position name="{JOINT}" joint="{JOINT}" kp="{loop.position_gain(firmware, stall):.5g}"{kv}
      forcerange="{-limit:.5g} {limit:.5g}"/>
  </actuator>
</mujoco>
"""
