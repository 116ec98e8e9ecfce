"""What sysid finds of camera and floor on virtual robots, whose truth is known.

  python benchmarks/identify_sensors.py --out out/sensors

Held by its torso in the true room a robot moves all joints and films: once as it should be; once
with a driver that stamps pictures when they arrive (40 ms late) and a lens declared 8 % too short;
once at half the gain, judged beside the first log. On a plane that slopes it stands, is lifted,
turned and put down three times. Prints a table in Markdown.
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and mujoco are imported)

import dataclasses
from pathlib import Path
from typing import Any

from benchmarks import harness

harness.one_thread()

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.robot_logs.reading import read_log
from nerf2real.evaluation.loop.robot import motions, recording
from nerf2real.real.virtual.camera import LENS, VirtualCamera
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.suite.op3 import constants
from nerf2real.sysid.sensors import floor, sensing
from nerf2real.sysid.sensors.sensed import Part

_STEP = constants.CONTROL_TIMESTEP
_LATE, _SCALE, _GAIN = 0.04, 1.08, 0.5
_GAMMA = 2.2  # of the virtual sensor: the gain acts on light, levels go with its power 1 / 2.2
_SLOPES = ((0.05, -0.02), (0.0, 0.0), (0.0, 0.06))  # rad


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """What sysid finds of camera and floor on virtual robots."""

  out: Path = Path("out/sensors")
  """Folder for the logs."""
  seeds: tuple[int, ...] = (1, 2)
  """Of the robots' hidden properties."""
  seconds: float = 10.0
  """Length of a filmed motion."""
  write: bool = False
  """Keep what is found as records in benchmarks/results/records/."""


def motion(seed: int, count: int) -> np.ndarray:
  """Returns actions [T, 20]: every joint swings about the standing pose, the head most."""
  rng = np.random.default_rng([seed, 9])
  lower, upper = constants.joint_limits()
  reach = np.array([0.35 if "head" in name else 0.1 for name in constants.JOINT_NAMES])
  centre = np.clip(constants.standing_targets(), lower + reach, np.maximum(upper - reach, lower))
  time = _STEP * np.arange(count)[:, None]
  rate, phase = rng.uniform(0.15, 1.0, (2, 20)), rng.uniform(0, 2 * np.pi, (2, 20))
  wave = sum(np.sin(2 * np.pi * r * time + p) for r, p in zip(rate, phase, strict=True)) / 2
  targets = centre + np.minimum(time / 1.5, 1.0) * reach * wave
  return np.clip((2 * targets - lower - upper) / (upper - lower), -1, 1).astype(np.float32)


class Arrival:
  """A camera whose driver takes pictures for as old as their arrival."""

  def __init__(self, camera: Any, late: float):
    """Takes the camera and how long its pictures travel [s]."""
    self._camera, self._late = camera, late

  def read(self) -> tuple[np.ndarray, float]:
    """Returns the newest picture and its supposed age [s]."""
    picture, age = self._camera.read()
    return picture, max(age - self._late, 0.0)

  def close(self) -> None:
    """Has nothing to free."""


def film(
  path: Path, arguments: Arguments, seed: int, *, wave: int, late: float, scale: float, gain: float
) -> None:
  """Records a held robot that moves and films."""
  camera = VirtualCamera(latency=_LATE, gain=gain)
  declared = dataclasses.replace(LENS, fx=LENS.fx / scale, fy=LENS.fy / scale)
  with VirtualRobot(stepped=True, seed=seed, world="room", camera=camera) as robot:
    connection = dataclasses.replace(robot.connection(), camera=Arrival(robot.camera, late))
    actions = motion(wave, round(arguments.seconds / _STEP))

    def play(gate: recording.Gate) -> None:
      recording.play_actions(connection, actions, robot, held=True, recorder=gate, lens=declared)

    recording.record(path, play)


def stand(folder: Path, seed: int, slope: tuple[float, float]) -> None:
  """Records a robot that stands on a slope, is lifted, turned and put down again and again."""

  def furnish(spec: mujoco.MjSpec) -> None:
    plane = next(geom for geom in spec.geoms if geom.name == "floor")
    plane.quat = Rotation.from_rotvec([*slope, 0.0]).as_quat(scalar_first=True)

  with VirtualRobot(stepped=True, seed=seed, furnish=furnish) as robot:
    recording.record_floor(folder, robot.connection(), robot)


def found(parts: dict[str, Part], *names: str) -> dict[str, harness.Value]:
  """Returns what parts of a finding name: in a line with intervals, and every value."""
  rows = [row for name in names for row in (parts[name].rows if name in parts else ())]
  texts = [
    f"{row['kind']} "
    + ", ".join(
      f"{name} {p['value']:.4f} ({p['low']:.4f} to {p['high']:.4f})"
      for name, p in row["parameters"].items()
    )
    for row in rows
  ]
  values = {
    f"{row['kind']}_{name}": p["value"] for row in rows for name, p in row["parameters"].items()
  }
  return {"found": "; ".join(texts) or "nothing", **values}


def main(arguments: Arguments) -> None:
  """Records what is missing in the folder, identifies, prints."""
  arguments.out.mkdir(parents=True, exist_ok=True)
  model = mujoco.MjModel.from_xml_string(motions.declared_model())
  free = motions.standing_model()
  figures: dict[str, dict[str, harness.Value]] = {}

  def note(name: str, truth: str, what: dict[str, harness.Value]) -> None:
    figures[name] = {"truth": truth, **what}
    print(f"{name}: {truth}: {what['found']}", flush=True)

  level = _GAIN ** (1 / _GAMMA)
  cases: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("healthy", "nothing", {"wave": 1, "late": 0.0, "scale": 1.0, "gain": 1.0}),
    (
      "late",
      f"{_LATE} s late, lens {_SCALE} of the declared",
      {"wave": 1, "late": _LATE, "scale": _SCALE, "gain": 1.0},
    ),
    (
      "dark",
      f"levels {level:.4f} of the first log's",
      {"wave": 2, "late": 0.0, "scale": 1.0, "gain": _GAIN},
    ),
  )
  for seed in arguments.seeds:
    for name, truth, settings in cases:
      path = arguments.out / f"{name}_{seed}.mcap"
      if not path.exists():
        film(path, arguments, seed, **settings)
      reference = [read_log(arguments.out / f"healthy_{seed}.mcap")] if name == "dark" else []
      parts = sensing.find(model, [read_log(path)], reference).parts
      note(f"seed_{seed}_camera_{name}", truth, found(parts, "camera", "brightness"))
    for slope in _SLOPES:
      folder = arguments.out / f"slope_{slope[0]}_{slope[1]}_{seed}"
      path = folder / f"{recording.FLOOR}.mcap"
      if not path.exists():
        stand(folder, seed, slope)
      part = floor.find(free, [read_log(path)])
      parts = {} if part is None else {"floor": part}
      truth = f"{slope[0]}, {slope[1]} rad"
      note(f"seed_{seed}_floor_{truth}", truth, found(parts, "floor"))
  options = harness.Options(write=arguments.write)
  harness.finish("identify_sensors", figures, options, seed=str(arguments.seeds))


if __name__ == "__main__":
  harness.run(main, Arguments, __doc__)
