"""How far the same open-loop walk gets: simulation, virtual robots, and one part changed at a time.

The gait's actions, straight ahead and without feedback, on a level floor. One reference is the
nominal simulation: rows `simulation_...` give one of its parts what the virtual robot has. The
other is the virtual robot as in its data sheets: the further rows change one part to the end of the
range that `Hidden.draw` has, or to what the simulation has. Distances [m] are by an observer, over
walks of several commanded speeds: a walk on contacts moves by some percent with any change, so
that a part counts where it moves all. Only the drawn robots have noise.

  python benchmarks/robot/walk_by_parts.py
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and mujoco are imported)

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

from benchmarks import harness

harness.one_thread()

import numpy as np

from benchmarks.robot import gap
from nerf2real import real, suite
from nerf2real.real.virtual.body import STEP
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.real.virtual.motors import RESISTANCE, SPEED_CONSTANT, MotorParameters
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.suite.arena import FLOOR_FRICTION
from nerf2real.suite.effects.effect import Effect
from nerf2real.suite.gaits.walk import Command, Gait
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import NOMINAL

_COUNT = len(constants.JOINT_NAMES)
_SHEET = Hidden.none(_COUNT)
# Of the virtual robot's voltage law at P = 800 and 12 V (real/virtual/motors.py), without friction.
_STIFFNESS = 26.4  # N m/rad
_BACK_EMF = SPEED_CONSTANT**2 / RESISTANCE + _SHEET.bearing_damping  # N m s/rad
_SIMULATED_CONTACT = 0.02  # s, MuJoCo's default, which the simulation has


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Settings of the comparison."""

  seconds: float = 6.0
  """Length of a walk."""
  speeds: tuple[float, ...] = (0.7, 0.85, 1.0)
  """Commanded speeds, as shares of the gait's largest."""
  robots: tuple[int, ...] = (1, 2, 3)
  """Seeds of the drawn virtual robots."""


def _each(value: float) -> np.ndarray:
  return np.full(_COUNT, value)


class Variant(NamedTuple):
  """The simulation with a part of the virtual robot's."""

  change: Callable[[Any], None] = lambda model: None  # of a compiled model
  options: dict[str, Any] | None = None  # of suite.load


def _set_contact(model: Any) -> None:
  model.geom_solref[:, 0] = _SHEET.contact_time


def _set_stiffness(model: Any) -> None:
  model.actuator_gainprm[:, 0] = _STIFFNESS
  model.actuator_biasprm[:, 1] = -_STIFFNESS


def _set_damping(model: Any) -> None:
  model.dof_damping[6:] = _BACK_EMF


def _set_friction(model: Any) -> None:
  model.geom_friction[:, 0] = _SHEET.foot_friction


def _set_drive(model: Any) -> None:
  for change in (_set_stiffness, _set_damping):
    change(model)


def _set_all(model: Any) -> None:
  for change in (_set_contact, _set_drive, _set_friction):
    change(model)


def variants() -> dict[str, Variant]:
  """Returns simulations by what they have of the virtual robot."""
  step, late = {"physics_timestep": STEP}, Effect("command_delay", parameters={"delay": 0.008})
  return {
    "simulation": Variant(),
    "simulation_contact": Variant(_set_contact),
    "simulation_friction": Variant(_set_friction),
    "simulation_stiffness": Variant(_set_stiffness),
    "simulation_back_emf": Variant(_set_damping),
    "simulation_drive": Variant(_set_drive),
    "simulation_step": Variant(options=step),
    "simulation_commands_8_ms_late": Variant(options={"effects": (late,)}),
    "simulation_all": Variant(_set_all, step),
  }


def parts() -> dict[str, Hidden]:
  """Returns virtual robots by what differs from the data sheets, one part each."""
  sheet = _SHEET

  def motors(**changes: Any) -> Hidden:
    found: MotorParameters = dataclasses.replace(sheet.motors, **changes)
    return dataclasses.replace(sheet, motors=found)

  share = sheet.motors.gear_share
  return {
    "data_sheet": sheet,
    "foot_friction_0.6": dataclasses.replace(sheet, foot_friction=0.6),
    "foot_friction_as_in_simulation": dataclasses.replace(sheet, foot_friction=FLOOR_FRICTION[0]),
    "contact_time_8_ms": dataclasses.replace(sheet, contact_time=0.008),
    "contact_time_as_in_simulation": dataclasses.replace(sheet, contact_time=_SIMULATED_CONTACT),
    "no_gear_friction": motors(gear_share=_each(0.0)),
    "gear_friction_1.2": motors(gear_share=1.2 * share),
    "dry_friction_0.07": motors(dry_friction=_each(0.07)),
    "strength_0.92": motors(strength=_each(0.92)),
    "strength_1.05": motors(strength=_each(1.05)),
    "battery_weak": motors(battery_voltage=11.6, battery_resistance=0.12),
    "goals_4_ms_late": motors(goal_delay=0.004),
    "bearing_damping_0.05": dataclasses.replace(sheet, bearing_damping=0.05),
    "armature_0.050": dataclasses.replace(sheet, armature=0.050),
    "payload_0.2": dataclasses.replace(sheet, payload=0.2, payload_position=(-0.01, 0.0, 0.06)),
  }


def actions(speed: float, count: int) -> np.ndarray:
  """Returns the gait's actions [T, 20] at a commanded speed, without feedback."""
  gait = Gait()
  return np.stack([gait.act(Command(speed)) for _ in range(count)])


def walked(environment: Any, motion: np.ndarray, place: Any) -> tuple[float, bool]:
  """Plays actions [T, 20]; returns how far the torso got [m] and whether the robot fell."""
  environment.reset()
  begin, fell = np.array(place()), False
  for action in motion:
    if environment.step(action).last():
      fell = True
      break
  return float(np.linalg.norm(np.array(place()) - begin)), fell


def row(found: list[tuple[float, bool]]) -> dict[str, harness.Value]:
  """Figures of one robot over its walks."""
  distances = [distance for distance, _ in found]
  return {
    "distance_m": float(np.mean(distances)),
    "smallest_m": min(distances),
    "largest_m": max(distances),
    "falls": sum(fell for _, fell in found),
  }


def in_simulation(
  motions: list[np.ndarray], settings: Settings, variant: Variant
) -> dict[str, harness.Value]:
  """Returns the figures of the simulation without randomisation, with a part changed."""
  environment = suite.load(
    "nerf_nav",
    image_size=None,
    random=0,
    randomisation=NOMINAL,
    privileged=False,
    time_limit=settings.seconds + 1.0,
    **(variant.options or {}),
  )
  variant.change(environment.physics.model.ptr)
  task: Any = environment.task
  task.set_start(Pose(*gap.Settings().start))
  return row([walked(environment, m, lambda: task.state.position[:2].copy()) for m in motions])


def on_a_robot(
  motions: list[np.ndarray], settings: Settings, **robot: Any
) -> dict[str, harness.Value]:
  """Returns the figures of a virtual robot on a level floor."""
  with VirtualRobot(world="floor", stepped=True, **robot) as virtual:
    environment = real.load(
      "nerf_nav",
      robot=virtual.connection(),
      image_size=None,
      time_limit=settings.seconds + 1.0,
    )
    found = []
    with environment:
      for motion in motions:
        virtual.place(0.0, 0.0, 0.0)
        found.append(walked(environment, motion, lambda: virtual.truth().position[:2].copy()))
  return row(found)


def main(settings: Settings) -> None:
  """Walks everywhere and prints the table."""
  motions = [actions(speed, round(settings.seconds * 40)) for speed in settings.speeds]
  rows = {name: in_simulation(motions, settings, variant) for name, variant in variants().items()}
  print(harness.table(rows), flush=True)
  for name, hidden in parts().items():
    rows[name] = on_a_robot(motions, settings, hidden=hidden)
    print(name, rows[name], flush=True)
  for seed in settings.robots:
    rows[f"robot_{seed}"] = on_a_robot(motions, settings, seed=seed)
  harness.finish("walk_by_parts", rows, settings, seed=0)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
