"""Hidden parameters of the virtual robot: drawn from a seed, or set by a test."""

import dataclasses
from typing import NamedTuple

import numpy as np

from nerf2real.real.virtual.motors import GEAR_SHARE, MotorParameters


class Load(NamedTuple):
  """A point mass fixed to a link."""

  link: str
  mass: float  # kg
  position: tuple[float, float, float]  # m in the link


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hidden:
  """The virtual robot's own physics, where it may differ from the simulation of `suite`."""

  motors: MotorParameters
  """The servos' motors and the battery."""
  armature: float = 0.045
  """kg m^2."""
  bearing_damping: float = 0.02
  """N m s/rad, besides back-EMF."""
  payload: float = 0.0
  """kg fixed to the torso."""
  payload_position: tuple[float, float, float] = (0.0, 0.0, 0.06)
  """m in the torso."""
  loads: tuple[Load, ...] = ()
  """Masses on other links."""
  floor_slope: tuple[float, float] = (0.0, 0.0)
  """Turn of floor and room about the world's x and y axes [rad]; positions stay those of the room,
  in which the floor is z = 0, and gravity turns the other way."""
  foot_friction: float = 0.8
  """Sliding coefficient."""
  contact_time: float = 0.012
  """s, time constant of contacts; the simulation has 0.02."""
  imu_tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
  """Rotation vector [rad]."""
  gyroscope_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
  """rad/s."""
  accelerometer_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
  """m/s^2."""
  gyroscope_noise: float = 0.002
  """rad/s, standard deviation of a reading."""
  accelerometer_noise: float = 0.03
  """m/s^2."""

  @classmethod
  def none(cls, count: int = 20) -> "Hidden":
    """Returns a robot as its data sheets have it, without noise."""
    return cls(motors=MotorParameters.nominal(count), gyroscope_noise=0.0, accelerometer_noise=0.0)

  @classmethod
  def draw(cls, seed: int, count: int = 20) -> "Hidden":
    """Draws a robot: the ranges are chosen, of the size that robots of one kind differ by."""
    rng = np.random.default_rng([seed, 5])
    motors = MotorParameters(
      strength=rng.uniform(0.92, 1.05, count),
      gear_share=rng.uniform(0.7, 1.2, count) * GEAR_SHARE,
      dry_friction=rng.uniform(0.02, 0.07, count),
      encoder_offset=rng.uniform(-6, 6, count),  # half a degree
      goal_delay=float(rng.uniform(0.0, 0.004)),
      battery_voltage=float(rng.uniform(11.6, 12.4)),
      battery_resistance=float(rng.uniform(0.05, 0.12)),
    )
    tilt = rng.normal(size=3)
    tilt *= np.deg2rad(rng.uniform(0, 2)) / np.linalg.norm(tilt)
    return cls(
      motors=motors,
      armature=float(rng.uniform(0.040, 0.050)),
      bearing_damping=float(rng.uniform(0.01, 0.05)),
      payload=float(rng.uniform(0.0, 0.2)),
      payload_position=(float(rng.uniform(-0.04, 0.02)), float(rng.uniform(-0.03, 0.03)), 0.06),
      foot_friction=float(rng.uniform(0.6, 1.0)),
      contact_time=float(rng.uniform(0.008, 0.016)),
      imu_tilt=(float(tilt[0]), float(tilt[1]), float(tilt[2])),
      gyroscope_bias=_small(rng, 0.01),
      accelerometer_bias=_small(rng, 0.1),
    )


def _small(rng: np.random.Generator, size: float) -> tuple[float, float, float]:
  x, y, z = rng.normal(0, size, 3)
  return float(x), float(y), float(z)
