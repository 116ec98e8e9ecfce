"""How well the robot's loop keeps its time, on the virtual bus with 20 servos.

The virtual robot runs in a process of its own and answers through a pseudo-terminal at 2 Mbps; the
loop is the one that runs on the robot: 40 Hz control, IMU and joints at 125 Hz. Every control step
uses some time for a policy. Where it may, the loop has real-time priority; elsewhere the
scheduler's delays dominate on a busy machine. `--stepped` shows what the wire alone costs, with
time that jumps from event to event.

  python benchmarks/robot/robot_loop.py                        # 10 minutes
  python benchmarks/robot/robot_loop.py --seconds 60 --loss 0.05
  python benchmarks/robot/robot_loop.py --stepped --loss 0.05  # the machine's speed does not matter
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and mujoco are imported)

import contextlib
import dataclasses
import os
import sys
import time
from collections.abc import Iterator
from typing import Any

from benchmarks import harness

harness.one_thread()  # idle OpenBLAS threads spin on a core

import numpy as np

from nerf2real import real
from nerf2real.real.clock import SteppedClock, prefer_this_thread
from nerf2real.real.loop.environment import RobotEnvironment
from nerf2real.real.safety.monitor import SafetyError
from nerf2real.real.virtual.camera import VirtualCamera
from nerf2real.real.virtual.process import VirtualRobotProcess
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.suite.op3 import constants

_SEED = 0  # of the virtual robot


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments(harness.Options):
  """How well the robot's loop keeps its time."""

  seconds: float = 600.0
  """Length of the run."""
  loss: float = 0.0
  """Share of packets that are lost, instructions and answers alike."""
  policy_ms: float = 5.0
  """Time a policy computes in every step [ms]; half of it holds Python's lock."""
  camera: bool = False
  """Whether pictures are streamed and read, too."""
  stepped: bool = False
  """Whether time is the wire's alone."""


def think(milliseconds: float) -> None:
  """Uses the processor as a policy does: half of the time in Python, half in a library."""
  middle = time.perf_counter() + milliseconds / 2000
  while time.perf_counter() < middle:
    pass
  end = middle + milliseconds / 2000
  matrix = np.ones((120, 120), np.float32)
  while time.perf_counter() < end:
    matrix @ matrix


def wave(step: int, standing: np.ndarray) -> np.ndarray:
  """Returns an action that keeps all joints moving a little."""
  phase = 2 * np.pi * 0.5 * step * constants.CONTROL_TIMESTEP
  return standing + 0.08 * np.sin(phase + np.arange(len(standing)))


@contextlib.contextmanager
def robot_for(arguments: Arguments) -> Iterator[Any]:
  """Starts the robot."""
  camera = VirtualCamera() if arguments.camera else None
  if arguments.stepped:
    with VirtualRobot(seed=_SEED, camera=camera, stepped=True) as robot:
      yield robot
  else:
    with VirtualRobotProcess(seed=_SEED, camera=camera) as robot:
      yield robot


def set_loss(robot: Any, loss: float) -> None:
  """Loses packets from now on."""
  if isinstance(robot, VirtualRobot):
    robot.faults.loss = loss
  else:
    robot.set_faults(loss=loss)


def run_steps(environment: RobotEnvironment, arguments: Arguments) -> list[float]:
  """Runs the loop; returns how long each step took [s]."""
  clock, standing = environment.bus.clock, environment.standing_action
  durations = []
  last = clock.now()
  for step in range(round(arguments.seconds / constants.CONTROL_TIMESTEP)):
    if isinstance(clock, SteppedClock):
      clock.sleep_until(clock.now() + arguments.policy_ms / 1000)
    else:
      think(arguments.policy_ms)
    timestep = environment.step(wave(step, standing))
    now = clock.now()
    durations.append(now - last)
    last = now
    if timestep.last():
      break
  return durations


def measure(arguments: Arguments) -> tuple[dict[str, harness.Value], dict[str, Any]]:
  """Returns the figures of a run, and how its durations spread."""
  with robot_for(arguments) as robot:
    environment = real.load(
      "nerf_nav",
      robot=robot.connection(),
      time_limit=2 * arguments.seconds,
      image_size=(30, 40) if arguments.camera else None,
    )
    with environment:
      if not arguments.stepped:
        prefer_this_thread(acting=True)
      environment.reset()
      set_loss(robot, arguments.loss)
      before, missed = dataclasses.replace(environment.bus.counts), environment.missed_bus_cycles
      begin, used = environment.bus.clock.now(), time.process_time()
      theirs = 0.0 if arguments.stepped else robot.processor_time()
      durations = run_steps(environment, arguments)
      elapsed, used = environment.bus.clock.now() - begin, time.process_time() - used
      theirs = 0.0 if arguments.stepped else robot.processor_time() - theirs
      after = environment.bus.counts
      stop = environment.stop
      set_loss(robot, 0.0)
      steps, cycles = len(durations), round(elapsed / constants.BUS_PERIOD)
      times = {"loop time": durations, **environment.timing.values}
      spreads = {name: _spread(1e3 * np.array(values)) for name, values in times.items()}
      figures: dict[str, harness.Value] = {
        "missed_deadlines": harness.Rate(
          environment.timing.counts["missed control deadlines"], steps
        ),
        "joint_readings_lost": harness.Rate(after.joint_losses - before.joint_losses, cycles),
        "imu_readings_lost": harness.Rate(after.imu_losses - before.imu_losses, cycles),
        "bus_cycles_not_begun": environment.missed_bus_cycles - missed,
        **{
          f"{name}_{mark}_ms".replace(" ", "_"): value
          for name, spread in spreads.items()
          for mark, value in spread.items()
        },
        "host_cores": round(used / elapsed, 3),
        "virtual_robot_cores": round(theirs / elapsed, 3),
      }
      details = {"stopped by": None if stop is None else f"{stop.reason}: {stop.detail}"}
      return figures, details | spreads


def _spread(values: np.ndarray) -> dict[str, float]:
  marks = {"median": 50, "p99": 99, "p99_9": 99.9, "max": 100}
  return {name: round(float(np.percentile(values, mark)), 3) for name, mark in marks.items()}


def main(arguments: Arguments) -> None:
  """Measures and prints."""
  try:
    figures, details = measure(arguments)
  except (SafetyError, OSError) as error:
    sys.exit(f"error: {error}\nIs the machine too busy? Load average {os.getloadavg()[0]:.1f}.")
  name = f"{'wire_alone' if arguments.stepped else 'real_time'}_loss_{arguments.loss:g}"
  name += "_camera" if arguments.camera else ""
  words = harness.table({key: {"value": value} for key, value in figures.items()}, first=name)
  print(f"{words}\n")
  harness.finish("robot_loop", {name: figures}, arguments, seed=_SEED, details=details)


if __name__ == "__main__":
  harness.run(main, Arguments, __doc__)
