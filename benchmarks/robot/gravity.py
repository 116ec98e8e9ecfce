"""How well the direction of gravity is known while the robot walks, and what spoils it.

The gait walks straight ahead on virtual robots and in simulation; the policy's newest `gravity` is
compared with the truth. On the virtual robots three ways: as it is, without the gyroscope's zero
that is measured while the robot stands, and with an accelerometer whose range never ends.

  python benchmarks/robot/gravity.py
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import dataclasses
from typing import Any

from benchmarks import harness

harness.one_thread()

import numpy as np

from nerf2real import real, suite
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.gaits.walk import Command, Gait
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import RandomisationSettings

_STANDARD_GRAVITY = 9.80665  # m/s^2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """How well the direction of gravity is known while the robot walks."""

  seconds: float = 20.0
  """Length of a walk."""
  robots: tuple[int, ...] = (1, 2, 3)
  """Seeds of the virtual robots."""
  episodes: int = 3
  """Walks in simulation."""


class Errors:
  """Angles between estimate and truth."""

  def __init__(self) -> None:
    self.degrees: list[float] = []

  def add(self, estimate: np.ndarray, truth: np.ndarray) -> None:
    """Notes two unit vectors [3]."""
    self.degrees.append(float(np.rad2deg(np.arccos(np.clip(estimate @ truth, -1, 1)))))

  def figures(self) -> dict[str, harness.Value]:
    """Returns RMS and last error."""
    rms = float(np.sqrt(np.mean(np.square(self.degrees))))
    return {"rms_degrees": rms, "end_degrees": self.degrees[-1]}


def _walk(environment: Any, truth: Any) -> Errors:
  timestep, gait, errors = environment.reset(), Gait(), Errors()
  while not timestep.last():
    gyroscope, gravity = (timestep.observation[name][-1] for name in ("gyroscope", "gravity"))
    timestep = environment.step(gait.act(Command(1.0), gyroscope=gyroscope, gravity=gravity))
    errors.add(timestep.observation["gravity"][-1], truth())
  return errors


def rehearsed(seed: int, seconds: float, *, zeroed: bool, endless: bool) -> tuple[Errors, float]:
  """Walks on a virtual robot; returns the errors and the largest specific force in the chip [g]."""
  settings = RobotSettings() if zeroed else RobotSettings(rest_time=0.0)
  with VirtualRobot(seed=seed, stepped=True) as robot:
    environment = real.load(
      "nerf_nav",
      robot=robot.connection(),
      image_size=None,
      scene=EmptyFloor(),
      time_limit=seconds,
      settings=settings,
    )
    sensing, line, peak = environment._cycle.sensing, robot.devices.board._line, [0.0]
    take = sensing.take_imu

    def take_true(reading: Any) -> np.ndarray:
      felt = line.read(reading.stamp)[3:]
      if environment._running:  # not while it is set down
        peak[0] = max(peak[0], float(np.abs(felt).max()))
      return take(reading._replace(accelerometer=felt) if endless else reading)

    sensing.take_imu = take_true  # type: ignore[method-assign]
    with environment:
      errors = _walk(environment, lambda: -robot.truth().rotation[2])
  return errors, peak[0] / _STANDARD_GRAVITY


def main(settings: Settings) -> None:
  """Walks everywhere and prints the table."""
  ways = {"": (True, False), "_zero_not_measured": (False, False), "_endless_range": (True, True)}
  figures: dict[str, dict[str, harness.Value]] = {}
  for seed in settings.robots:
    for name, (zeroed, endless) in ways.items():
      errors, peak = rehearsed(seed, settings.seconds, zeroed=zeroed, endless=endless)
      figures[f"virtual_robot_{seed}{name}"] = errors.figures() | {"largest_force_g": peak}
  environment = suite.load(
    "nerf_nav",
    scene=EmptyFloor(),
    image_size=None,
    random=0,
    time_limit=settings.seconds,
    randomisation=RandomisationSettings(pushes=False),
    privileged=False,
  )
  task = environment.task
  task.set_start(Pose(0.0, 0.0, 0.0))
  for episode in range(settings.episodes):
    errors = _walk(environment, lambda: -task.state.rotation[2])
    figures[f"simulation_episode_{episode}"] = errors.figures()
  for plant in ("virtual_robot", "simulation"):
    names = [n for n in figures if n.startswith(plant) and "range" not in n and "zero" not in n]
    rms = [float(figures[name]["rms_degrees"]) for name in names]  # type: ignore[arg-type]
    figures[f"{plant}s"] = {"smallest_rms_degrees": min(rms), "largest_rms_degrees": max(rms)}
  harness.finish("gravity", figures, settings, seed=0)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
