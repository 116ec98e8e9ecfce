"""Closes the loop once: excite a robot, record, identify, put the effects into the suite, compare.

  python launch/close_loop.py --robot virtual --seed 1 --out out/loop

The robot is held by its torso in the air and moves all joints: a sweep, a slow motion and steps to
identify from, a motion of other frequencies to judge by. The declared model is the suite's OP3,
held likewise. The table at the end is the gap between robot and suite, joint by joint, on motions
that were not fitted: standing on the floor and in the air, without and with the effects found.
"""

import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
import tyro

from nerf2real import real, suite, sysid
from nerf2real.real.loading import Connection
from nerf2real.real.recorder.recorder import Recorder
from nerf2real.suite.op3 import constants
from nerf2real.suite.op3.op3 import OP3
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.tasks.base import Start

VIRTUAL = "virtual"
_STEP = constants.CONTROL_TIMESTEP
_TRAIN = ("sweep", "slow", "steps")
_HELD = ("mixed",)
_RAMP = 1.5  # s from the standing pose to a motion
_LIFTING = 2.0  # s until a robot that was taken by its torso hangs still
_NOMINAL = RandomisationSettings(
  pushes=False, delays=False, jitter=False, torso_mass=False, imu_pose=False
)
_REACH = {
  "head": 0.35,
  "sho_pitch": 0.6,
  "sho_roll": 0.3,
  "el": 0.35,
  "hip_yaw": 0.15,
  "hip_roll": 0.1,
  "hip_pitch": 0.4,
  "knee": 0.4,
  "ank_pitch": 0.4,
  "ank_roll": 0.25,
}
"""rad to both sides, by a part of the joint's name: gravity loads joints, no limb meets another."""
_SWAY = 0.1  # of the reach, standing on the floor


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Closes the loop once."""

  robot: str = VIRTUAL
  """Serial port such as /dev/ttyUSB0, or "virtual"."""
  seed: int = 1
  """Of the virtual robot's hidden properties."""
  seconds: float = 12.0
  """Length of a recorded motion."""
  reuse: bool = False
  """Take the logs that an earlier run left in the folder instead of moving the robot."""
  out: Path = Path("out/loop")
  """Folder for logs, model, report and table."""


def main() -> int:
  """Runs the command line."""
  arguments = tyro.cli(Arguments, description=__doc__)
  try:
    run(arguments)
  except (OSError, RuntimeError, ValueError) as error:
    print(f"error: {error}", file=sys.stderr)
    return 2
  return 0


def run(arguments: Arguments) -> dict[str, Any]:
  """Excites, records, identifies, compares; returns report.json's content with the gap."""
  arguments.out.mkdir(parents=True, exist_ok=True)
  model = arguments.out / "declared.xml"
  model.write_text(declared_model())
  if not arguments.reuse:
    moved = _excite(arguments)
    np.savez(arguments.out / "standing.npz", actions=moved["actions"], positions=moved["positions"])
  standing = np.load(arguments.out / "standing.npz")
  logs = {name: arguments.out / f"{name}.mcap" for name in (*_TRAIN, *_HELD)}
  content = sysid.identify(
    model,
    [logs[name] for name in _TRAIN],
    held=[logs[name] for name in _HELD],
    out=arguments.out / "identified",
  )
  before = _suite_motion(None, standing["actions"])
  after = _suite_motion(arguments.out / "identified" / "effects.json", standing["actions"])
  table = gap_table(standing["positions"], before, after, content)
  if arguments.robot == VIRTUAL:
    table += hidden_table(arguments.seed, content, arguments.out / "identified" / "details.json")
  (arguments.out / "gap.md").write_text(table)
  print(table)
  print(f"report: {arguments.out / 'identified' / 'report.html'}")
  return content


def declared_model() -> str:
  """Returns the suite's OP3 held by its torso, without contacts, as MJCF."""
  robot = OP3()
  root = robot.mjcf_model
  root.option.timestep = 0.001
  root.option.integrator = "implicitfast"
  root.option.flag.contact = "disable"
  text = root.to_xml_string()
  mujoco.MjModel.from_xml_string(text)
  return text


def motion(kind: str, count: int) -> np.ndarray:
  """Returns actions [T, 20] about the standing pose.

  Args:
    kind: "sweep", "slow", "steps", "mixed" or "sway".
    count: control steps T.
  """
  rng = np.random.default_rng([3, ("sweep", "slow", "steps", "mixed", "sway").index(kind)])
  lower, upper = constants.joint_limits()
  reach = np.array(
    [next(r for part, r in _REACH.items() if part in name) for name in constants.JOINT_NAMES]
  )
  standing = constants.standing_targets()
  time = _STEP * np.arange(count)[:, None]
  phase = rng.uniform(0, 2 * np.pi, 20)
  duration = count * _STEP
  if kind == "sweep":
    wave = np.sin(2 * np.pi * (0.2 * time + 0.5 * 1.6 / duration * time**2) + phase)
  elif kind == "slow":
    wave = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 0.15 * time + phase))
  elif kind == "steps":
    levels = rng.uniform(-1, 1, (int(duration / 1.2) + 2, 20))
    wave = levels[(time[:, 0] / 1.2).astype(int)]
  elif kind == "mixed":
    rates = rng.uniform(0.2, 1.4, (3, 20))
    wave = sum(np.sin(2 * np.pi * r * time + p) for r, p in zip(rates, (0, 1, 2), strict=True)) / 3
  else:
    wave = _SWAY * np.sin(2 * np.pi * rng.uniform(0.3, 1.0, 20) * time + phase)
  away = np.minimum(time / _RAMP, 1.0)
  centre = standing
  if kind != "sway":  # all of the reach lies within the limits
    centre = np.clip(standing, lower + reach, np.maximum(upper - reach, lower + reach))
  targets = standing + away * (centre - standing + reach * wave)
  middle, half = (lower + upper) / 2, (upper - lower) / 2
  return np.clip((targets - middle) / half, -1, 1).astype(np.float32)


def _excite(arguments: Arguments) -> dict[str, np.ndarray]:
  """Records all motions; returns actions and joint positions of the standing one."""
  if arguments.robot != VIRTUAL:
    return _on(Connection(port=arguments.robot), arguments, None)
  from nerf2real.real.virtual.robot import VirtualRobot

  with VirtualRobot(stepped=True, seed=arguments.seed) as robot:
    return _on(robot.connection(), arguments, robot)


class Gate:
  """A recorder that notes nothing until it is opened: what happens before is no part of a log."""

  def __init__(self, recorder: Recorder):
    """Takes the recorder, closed."""
    self._recorder = recorder
    self.open = False

  def __getattr__(self, name: str) -> Any:
    """Returns the recorder's method, or one that does nothing."""
    return getattr(self._recorder, name) if self.open else _ignore


def _ignore(*_: Any, **__: Any) -> None:
  """Notes nothing."""


def _on(connection: Connection, arguments: Arguments, robot: Any) -> dict[str, np.ndarray]:
  count = round(arguments.seconds / _STEP)
  for name in (*_TRAIN, *_HELD):
    with Recorder(arguments.out / f"{name}.mcap") as recorder:
      _play(connection, motion(name, count), robot, recorder=Gate(recorder), held=True)
    if recorder.dropped:
      raise RuntimeError(
        f"Found {recorder.dropped} messages missing in {name}.mcap, expected none: the recorder did"
        " not keep up; run again on a machine with less load."
      )
  actions = motion("sway", count)
  return {"actions": actions, "positions": _play(connection, actions, robot, held=False)}


def _play(
  connection: Connection,
  actions: np.ndarray,
  robot: Any,
  *,
  held: bool,
  recorder: Gate | None = None,
) -> np.ndarray:
  """Plays actions [T, 20] and returns the joint positions [T, 20] that were observed."""
  rows = []
  lifting = round(_LIFTING / _STEP) if held else 0
  with real.load(
    "nerf_nav",
    robot=connection,
    image_size=None,
    time_limit=(lifting + len(actions)) * _STEP + 1.0,
    recorder=recorder,
  ) as environment:
    environment.reset()
    if held:
      if robot is not None:
        robot.hold(True)
      else:
        print(f"Lift the robot by its torso, feet off the ground, within {_LIFTING:g} s.")
    for index, action in enumerate([*np.repeat(actions[:1], lifting, axis=0), *actions]):
      if index == lifting and recorder is not None:
        recorder.open = True
      timestep = environment.step(action)
      if index >= lifting:
        rows.append(timestep.observation["joint_positions"][-1].copy())
      if timestep.last():
        raise RuntimeError(
          f"Found the episode ended after {len(rows)} steps ({environment.stop}), expected"
          f" {len(actions)}: look at the robot."
        )
    if recorder is not None:
      recorder.open = False
  return np.array(rows)


def _suite_motion(effects: Path | None, actions: np.ndarray) -> np.ndarray:
  """Returns the joint positions [T, 20] that the suite gives for the same actions."""
  environment = suite.load(
    "nerf_nav",
    image_size=None,
    random=0,
    randomisation=_NOMINAL,
    privileged=False,
    time_limit=len(actions) * _STEP + 1.0,
    effects=effects,
  )
  environment.task.set_start(Start((0.0, 0.0), 0.0))
  environment.reset()
  rows = []
  for action in actions:
    timestep = environment.step(action)
    rows.append(timestep.observation["joint_positions"][-1].copy())
    if timestep.last():
      break
  return np.array(rows)


def gap_table(
  robot: np.ndarray, before: np.ndarray, after: np.ndarray, content: dict[str, Any]
) -> str:
  """Returns the gap in Markdown: joint positions, standing on the floor and held in the air."""
  count = min(len(robot), len(before), len(after))
  gaps = [
    np.rad2deg(np.sqrt(np.mean((robot[:count] - simulated[:count]) ** 2, axis=0)))
    for simulated in (before, after)
  ]
  lines = [
    f"Joint positions, RMS over {count * _STEP:.0f} s of swaying on the floor (not fitted).",
    "",
    "| joint | nominal suite [deg] | with effects [deg] |",
    "| --- | --- | --- |",
  ]
  for index, name in enumerate(constants.JOINT_NAMES):
    lines.append(f"| {name} | {gaps[0][index]:.3f} | {gaps[1][index]:.3f} |")
  lines.append(f"| mean | {gaps[0].mean():.3f} | {gaps[1].mean():.3f} |")
  held = content["error"]["held"]
  lines += [
    "",
    "Held in the air, whole log, all joints (mrad RMS): declared"
    f" {1e3 * held['before']:.2f}, extended {1e3 * held['after']:.2f}, noise of the readings"
    f" {1e3 * content['error']['floor']:.2f}.",
    "",
    f"Verdict: {content['verdict']}: "
    + (", ".join(f"{e['kind']} ({e['joint'] or 'all'})" for e in content["effects"]) or "nothing"),
  ]
  return "\n".join(lines) + "\n"


def hidden_table(seed: int, content: dict[str, Any], details: Path) -> str:
  """Returns what the virtual robot hides beside what was found, in Markdown."""
  from nerf2real.real.virtual import motors
  from nerf2real.real.virtual.hidden import Hidden

  hidden = Hidden.draw(seed)
  duty = 800 / 128 * motors.COUNTS / (2 * np.pi) / motors.FULL_PWM  # per rad at a P gain of 800
  stall = motors.SPEED_CONSTANT * hidden.motors.battery_voltage / motors.RESISTANCE
  strength = duty * stall * hidden.motors.strength / constants.POSITION_GAIN
  constants_of = json.loads(details.read_text())["calibration"]
  lines = [
    "",
    "Share of the torque that the gear takes, and strength over the declared one (voltage law and",
    "battery included). Without a load strength cannot be told from all constants being smaller.",
    "",
    "| joint | gear's share | found | strength | found | also named |",
    "| --- | --- | --- | --- | --- | --- |",
  ]
  for index, name in enumerate(constants.JOINT_NAMES):
    own = {e["kind"]: e["parameters"] for e in content["effects"] if e["joint"] == name}
    share = own.pop("load_friction", {}).get("coefficient", {}).get("value")
    gain = own.pop("motor_gain", {}).get("gain", {}).get("value", 1.0)
    gain *= constants_of[name].get("gain", 1.0)
    found = "not named" if share is None else f"{share:.2f}"
    lines.append(
      f"| {name} | {hidden.motors.gear_share[index]:.2f} | {found} | {strength[index]:.2f} |"
      f" {gain:.2f} | {', '.join(own) or '-'} |"
    )
  whole = [e for e in content["effects"] if e["joint"] is None]
  for effect in whole:
    values = ", ".join(
      f"{n} {p['value']:.4g}" for n, p in effect["parameters"].items() if p["value"] is not None
    )
    lines += ["", f"Of the whole robot: {effect['kind']} ({values})."]
  bias = ", ".join(f"{value:.4f}" for value in hidden.gyroscope_bias)
  late = 1e3 * hidden.motors.goal_delay
  lines += [
    "",
    f"Hidden besides: gyroscope's zero {bias} rad/s, goals {late:.1f} ms late, encoders off by up"
    " to half a degree.",
  ]
  return "\n".join(lines) + "\n"


if __name__ == "__main__":
  sys.exit(main())
