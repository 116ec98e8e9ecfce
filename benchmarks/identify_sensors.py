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

from nerf2real import real
from nerf2real.core.robot_logs.reading import read_log
from nerf2real.core.rotations import yaw_quaternion
from nerf2real.real.recorder.recorder import Recorder
from nerf2real.real.virtual.camera import LENS, VirtualCamera
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.suite.op3 import constants
from nerf2real.suite.op3.op3 import OP3
from nerf2real.sysid.sensors import floor, sensing
from nerf2real.sysid.sensors.sensed import Part

_STEP = constants.CONTROL_TIMESTEP
_LATE, _SCALE, _GAIN = 0.04, 1.08, 0.5
_GAMMA = 2.2  # of the virtual sensor: the gain acts on light, levels go with its power 1 / 2.2
_HEADINGS = (0.0, 1.2, 2.4, 3.6)  # rad
_TURNING = 1.0  # rad/s of the person who turns the robot
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


class Gate:
  """A recorder that notes nothing until it is opened."""

  def __init__(self, recorder: Recorder):
    """Takes the recorder, closed."""
    self._recorder = recorder
    self.open = False

  def __getattr__(self, name: str) -> Any:
    """Returns the recorder's method, or one that does nothing."""
    return getattr(self._recorder, name) if self.open else lambda *_, **__: None


def held_model() -> mujoco.MjModel:
  """Returns the suite's OP3 held by its torso, without contacts."""
  root = OP3().mjcf_model
  root.option.flag.contact = "disable"
  return mujoco.MjModel.from_xml_string(root.to_xml_string())


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
  with VirtualRobot(stepped=True, seed=seed, world="room", camera=camera) as robot:
    connection = dataclasses.replace(robot.connection(), camera=Arrival(robot.camera, late))
    actions = motion(wave, round(arguments.seconds / _STEP))
    lifting = round(2.0 / _STEP)
    with Recorder(path) as recorder:
      gate = Gate(recorder)
      with real.load(
        "nerf_nav",
        robot=connection,
        image_size=(30, 40),
        recorder=gate,
        time_limit=(lifting + len(actions)) * _STEP + 1.0,
      ) as environment:
        environment.reset()
        robot.hold(True)
        for index, action in enumerate([*np.repeat(actions[:1], lifting, axis=0), *actions]):
          if index == lifting:
            gate.open = True
            declared = dataclasses.replace(LENS, fx=LENS.fx / scale, fy=LENS.fy / scale)
            recorder.camera_info(robot.clock.wall(robot.clock.now()), declared)
          environment.step(action)
        gate.open = False


def stand(path: Path, seed: int, slope: tuple[float, float]) -> None:
  """Records a robot that stands on a slope, is lifted, turned and put down again and again."""

  def furnish(spec: mujoco.MjSpec) -> None:
    plane = next(geom for geom in spec.geoms if geom.name == "floor")
    plane.quat = Rotation.from_rotvec([*slope, 0.0]).as_quat(scalar_first=True)

  with VirtualRobot(stepped=True, seed=seed, furnish=furnish) as robot:
    hand = int(robot.body.model.body("hand").mocapid[0])
    lower, upper = constants.joint_limits()
    targets = constants.standing_targets()
    action = np.float32(np.clip((2 * targets - lower - upper) / (upper - lower), -1, 1))
    with Recorder(path) as recorder:
      gate = Gate(recorder)
      with real.load(
        "nerf_nav", robot=robot.connection(), image_size=None, recorder=gate, time_limit=60.0
      ) as environment:
        environment.reset()
        for _ in range(round(1.0 / _STEP)):
          environment.step(action)
        gate.open = True
        for index, heading in enumerate(_HEADINGS):
          for _ in range(round(2.0 / _STEP)):
            environment.step(action)
          if index + 1 == len(_HEADINGS):
            break
          robot.hold(True)
          turn = _HEADINGS[index + 1] - heading
          steps = round(turn / _TURNING / _STEP)
          yaws = robot.truth().yaw + turn * np.arange(1, steps + 1) / steps
          for yaw in yaws:
            robot.body.data.mocap_quat[hand] = yaw_quaternion(yaw)
            environment.step(action)
          robot.hold(False)
          for _ in range(round(1.0 / _STEP)):
            environment.step(action)
        gate.open = False


def standing_model() -> mujoco.MjModel:
  """Returns the suite's OP3, free, on a plane."""
  spec = mujoco.MjSpec.from_string(OP3().mjcf_model.to_xml_string())
  spec.body(constants.TORSO_LINK).add_freejoint()
  spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1])
  return spec.compile()


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
  model, free = held_model(), standing_model()
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
      path = arguments.out / f"slope_{slope[0]}_{slope[1]}_{seed}.mcap"
      if not path.exists():
        stand(path, seed, slope)
      part = floor.find(free, [read_log(path)])
      parts = {} if part is None else {"floor": part}
      truth = f"{slope[0]}, {slope[1]} rad"
      note(f"seed_{seed}_floor_{truth}", truth, found(parts, "floor"))
  options = harness.Options(write=arguments.write)
  harness.finish("identify_sensors", figures, options, seed=str(arguments.seeds))


if __name__ == "__main__":
  harness.run(main, Arguments, __doc__)
