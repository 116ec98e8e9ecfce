"""How well the robot's loop keeps its time, on the virtual bus with 20 servos.

The virtual robot runs in a process of its own and answers through a pseudo-terminal at 2 Mbps; the
loop is the one that runs on the robot: 40 Hz control, IMU and joints at 125 Hz. Every control step
may use some time for a policy.

  python benchmarks/robot_loop.py                         # 10 minutes
  python benchmarks/robot_loop.py --seconds 60 --loss 0.05
"""

import dataclasses
import json
import os
import time
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import tyro

import real
from real.virtual.process import VirtualRobotProcess
from suite.op3 import constants

RESULTS = Path(__file__).parent / "results" / "robot_loop.json"


@dataclasses.dataclass(frozen=True)
class Arguments:
  """How well the robot's loop keeps its time."""

  seconds: float = 600.0
  """Length of the run."""
  loss: float = 0.0
  """Share of packets that are lost, instructions and answers alike."""
  policy_ms: float = 5.0
  """Time a policy computes in every step [ms]; half of it holds Python's lock."""
  camera: bool = False
  """Whether pictures are streamed and read, too."""
  write: bool = False
  """Whether to keep the figures in benchmarks/results/robot_loop.json."""


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


def measure(arguments: Arguments) -> dict:
  """Runs the loop; returns the figures."""
  with VirtualRobotProcess(seed=0, camera=arguments.camera) as robot:
    environment = real.load(
      "nerf_nav", robot=robot.connection(), time_limit=2 * arguments.seconds,
      image_size=(30, 40) if arguments.camera else None,
    )  # fmt: skip
    with environment:
      environment.reset()
      robot.set_faults(loss=arguments.loss)
      counts = dataclasses.replace(environment.bus.counts)
      missed = environment.missed_bus_cycles
      begin, used, theirs = time.monotonic(), time.process_time(), robot.processor_time()
      steps = round(arguments.seconds / constants.CONTROL_TIMESTEP)
      durations, done = [], 0
      last = time.monotonic()
      for step in range(steps):
        think(arguments.policy_ms)
        timestep = environment.step(wave(step, environment.standing_action))
        now = time.monotonic()
        durations.append(now - last)
        last, done = now, step + 1
        if timestep.last():
          break
      elapsed = time.monotonic() - begin
      after = environment.bus.counts
      robot.set_faults(loss=0.0)
      return {
        "arguments": dataclasses.asdict(arguments),
        "stopped by": None if environment.stop is None else str(environment.stop),
        "control steps": done,
        "missed control deadlines": environment.timing.counts["missed control deadlines"],
        "bus cycles not begun": environment.missed_bus_cycles - missed,
        "bus cycles": round(elapsed / constants.BUS_PERIOD),
        "joint readings lost": after.joint_losses - counts.joint_losses,
        "imu readings lost": after.imu_losses - counts.imu_losses,
        "loop time [ms]": _spread(1e3 * np.array(durations)),
        **{
          f"{name} [ms]": _spread(1e3 * np.array(values))
          for name, values in environment.timing.values.items()
        },
        "processor share of the host": (time.process_time() - used) / elapsed,
        "processor share of the virtual robot": (robot.processor_time() - theirs) / elapsed,
        "load average": os.getloadavg()[0],
        "cores": os.cpu_count(),
      }


def _spread(values: np.ndarray) -> dict[str, float]:
  marks = {"median": 50, "p99": 99, "p99.9": 99.9, "max": 100}
  return {name: round(float(np.percentile(values, mark)), 3) for name, mark in marks.items()}


def main() -> None:
  """Measures and prints."""
  arguments = tyro.cli(Arguments, description=__doc__)
  found = measure(arguments)
  for name, value in found.items():
    if isinstance(value, dict):
      value = "  ".join(f"{key} {number}" for key, number in value.items())
    elif isinstance(value, float):
      value = f"{value:.2f}"
    print(f"{name:38s} {value}")
  if arguments.write:
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    kept[f"loss {arguments.loss:g}, camera {arguments.camera}"] = found
    RESULTS.write_text(json.dumps(kept, indent=1) + "\n")
    print(f"wrote {RESULTS}")


if __name__ == "__main__":
  main()
