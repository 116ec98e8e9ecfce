"""One machine as it really is: the declared model plus this copy's own background constants."""

import dataclasses

import numpy as np

from .apparatus import Apparatus
from .plant import COUNTS_PER_RADIAN, FULL_DUTY, REGISTER_ONE, Servo, World, make_servos
from .rigid_body import Tree, read_tree


@dataclasses.dataclass
class Machine:
  """A plant and how it is read; effects change it in place. J joints."""

  tree: Tree
  servo: Servo
  world: World
  dropouts: list[tuple[int, float, float]]
  measurement_delay: np.ndarray
  """[J] s by which positions and velocities are reported late."""
  clock_rate: float
  """By how much the clock of the measurements runs fast."""
  stamps_only: bool
  """The fast clock is in the header stamps only, not in the log times."""
  effort_scale: np.ndarray
  """[J] reported over true torque of the motor."""


@dataclasses.dataclass(frozen=True)
class Reading:
  """How the host reads the servos, drawn once a set."""

  command_period: float = 0.02
  state_period: float = 0.01
  stamp_jitter: float = 1e-3
  """s, largest deviation of a cycle from its nominal time."""
  whole_milliseconds: bool = True
  """The host's timer has a resolution of 1 ms."""
  read_skew: float = 1.2e-4
  """s between the readings of two joints of one message."""
  read_jitter: float = 2e-4
  """s, between a stamp and the reading that it is for."""
  stale: float = 0.002
  """Probability that a joint's reading is the last one again."""
  velocity_ticks: int = 4
  """Firmware ticks that the velocity is averaged over."""
  velocity_noise: float = 0.015
  effort_noise: float = 0.02
  encoder_noise: float = 0.15
  """Counts, before rounding."""
  with_duty: bool = False
  with_temperature: bool = True
  settled: bool = True
  """The machine has come to rest under load before a log starts."""


def draw_reading(rng: np.random.Generator) -> Reading:
  """Draws the host."""
  return Reading(
    stamp_jitter=rng.uniform(0.2e-3, 1.2e-3),
    whole_milliseconds=bool(rng.random() < 0.6),
    read_skew=rng.uniform(0.9e-4, 1.5e-4),
    read_jitter=rng.uniform(0.5e-4, 3e-4),
    stale=rng.uniform(0.0, 0.004),
    velocity_ticks=int(rng.integers(2, 9)),
    velocity_noise=rng.uniform(0.005, 0.02),
    effort_noise=rng.uniform(0.01, 0.025),
    encoder_noise=rng.uniform(0.05, 0.25),
    with_duty=bool(rng.random() < 0.3),
    with_temperature=bool(rng.random() < 0.7),
    settled=bool(rng.random() < 0.5),
  )


def build_machine(
  apparatus: Apparatus, rng: np.random.Generator, *, declared_error: float = 0.0
) -> Machine:
  """Draws a machine whose constants scatter about the declared ones as servos of a batch do.

  Args:
    apparatus: the declared model.
    rng: draws the scatter.
    declared_error: damping, armature and friction of all joints are off by this share, each in a
      direction of its own.
  """
  model = apparatus.model
  count = model.njnt
  tree = read_tree(model)
  tree = tree._replace(mass=tree.mass * (1 + rng.normal(0, 0.004, count)))
  off = 1 + declared_error * rng.choice([-1.0, 1.0], 3)
  dof = model.jnt_dofadr
  damping = model.dof_damping[dof] * off[0] * (1 + rng.normal(0, 0.006, count))
  inertia = model.dof_armature[dof] * off[1] * (1 + rng.normal(0, 0.01, count))
  coulomb = model.dof_frictionloss[dof] * off[2] * rng.uniform(0.85, 1.15, count)
  limit = model.actuator_forcerange[:, 1]
  register = np.round(
    model.actuator_gainprm[:, 0] / limit * FULL_DUTY / COUNTS_PER_RADIAN * REGISTER_ONE
  )
  servo = make_servos(
    count,
    motor_inertia=0.98 * inertia,
    output_inertia=0.02 * inertia,
    viscous=damping,
    coulomb=coulomb,
    breakaway=coulomb * rng.uniform(0.0, 0.3, count),
    stribeck_velocity=rng.uniform(0.05, 0.3, count),
    load=rng.uniform(0.0, 0.01, count),
    presliding=rng.uniform(1.5e-4, 4e-4, count),
    gear_stiffness=rng.uniform(800, 1500, count),
    gear_damping=rng.uniform(0.3, 0.6, count),
    gap=rng.uniform(1e-4, 5e-4, count),
    cogging_amplitude=rng.uniform(0.001, 0.006, count),
    cogging_periods=rng.uniform(20, 60, count),
    cogging_phase=rng.uniform(-np.pi, np.pi, count),
    stall=limit * (1 + rng.normal(0, 0.004, count)),
    electrical_lag=rng.uniform(1e-4, 4e-4, count),
    register=register,
    duty_limit=FULL_DUTY,
    eccentricity=rng.uniform(0, 4e-4, count),
    eccentricity_phase=rng.uniform(-np.pi, np.pi, count),
    latency=rng.uniform(0.0, 4e-4, count),
  )
  lean = rng.normal(0, 0.001, 2)
  gravity = model.opt.gravity @ _small_turn(*lean)
  return Machine(
    tree=tree,
    servo=servo,
    world=World(gravity, 12.0, 0.0, 0.0, COUNTS_PER_RADIAN, FULL_DUTY, 1000),
    dropouts=[],
    measurement_delay=np.zeros(count),
    clock_rate=0.0,
    stamps_only=False,
    effort_scale=np.ones(count),
  )


def turn_gravity(machine: Machine, x: float, y: float) -> None:
  """Turns gravity by the rotation vector (x, y, 0), rad, along the world's axes."""
  machine.world = machine.world._replace(gravity=machine.world.gravity @ _small_turn(x, y))


def _small_turn(x: float, y: float) -> np.ndarray:
  """Returns the transpose of the rotation [3, 3] about (x, y, 0): Rodrigues' formula."""
  angle = float(np.hypot(x, y))
  if angle == 0:
    return np.eye(3)
  ux, uy = x / angle, y / angle
  cross = np.array([[0, 0, uy], [0, 0, -ux], [-uy, ux, 0]])
  rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
  return rotation.T
