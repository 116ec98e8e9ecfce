"""The gap between a robot and the suite, joint by joint, and what a virtual robot hides."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real import suite
from nerf2real.core import markdown
from nerf2real.suite.effects import Effect
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import NOMINAL
from nerf2real.sysid.report.servo import by_law

_STEP = constants.CONTROL_TIMESTEP


def suite_motion(effects: Path | Sequence[Effect] | None, actions: np.ndarray) -> np.ndarray:
  """Returns the joint positions [T, 20] that the suite gives for the same actions."""
  environment = suite.load(
    "nerf_nav",
    image_size=None,
    random=0,
    randomisation=NOMINAL,
    privileged=False,
    time_limit=len(actions) * _STEP + 1.0,
    effects=effects,
  )
  environment.task.set_start(Pose(0.0, 0.0, 0.0))
  environment.reset()
  rows = []
  for action in actions:
    timestep = environment.step(action)
    rows.append(timestep.observation["joint_positions"][-1].copy())
    if timestep.last():
      break
  return np.array(rows)


def gaps_between(robot: np.ndarray, simulated: np.ndarray) -> np.ndarray:
  """Returns the RMS of every joint's gap [20] between motions [T, 20], deg, over the shorter."""
  count = min(len(robot), len(simulated))
  return np.rad2deg(np.sqrt(np.mean((robot[:count] - simulated[:count]) ** 2, axis=0)))


def gap_table(
  robot: np.ndarray, before: np.ndarray, after: np.ndarray, content: dict[str, Any]
) -> str:
  """Returns the gap in Markdown: joint positions, standing on the floor and held in the air."""
  count = min(len(robot), len(before), len(after))
  gaps = [gaps_between(robot, simulated[:count]) for simulated in (before, after)]
  rows = {name: [gap[index] for gap in gaps] for index, name in enumerate(constants.JOINT_NAMES)}
  rows["mean"] = [gap.mean() for gap in gaps]
  held = content["error"]["held"]
  lines = [
    f"Joint positions, RMS over {count * _STEP:.0f} s of swaying on the floor (not fitted).",
    "",
    markdown.table(
      ("joint", "nominal suite [deg]", "with effects [deg]"),
      [(name, *(f"{value:.3f}" for value in values)) for name, values in rows.items()],
    ),
    "",
    "Held in the air, whole log, all joints (mrad RMS): declared"
    f" {1e3 * held['before']:.2f}, extended {1e3 * held['after']:.2f}, noise of the readings"
    f" {1e3 * content['error']['floor']:.2f}.",
    "",
    f"Verdict: {content['verdict']}: "
    + (", ".join(f"{e['kind']} ({e['joint'] or 'all'})" for e in content["effects"]) or "nothing"),
  ]
  return "\n".join(lines) + "\n"


def with_hidden_zeros(seed: int, effects: Sequence[Effect]) -> list[Effect]:
  """Returns effects with the zeros of a virtual robot's encoders in place of those found."""
  from nerf2real.real.virtual import motors
  from nerf2real.real.virtual.hidden import Hidden

  zeros = 2 * np.pi / motors.COUNTS * Hidden.draw(seed).motors.encoder_offset
  others = [e for e in effects if e.kind != "encoder_offset"]
  own = zip(constants.JOINT_NAMES, zeros, strict=True)
  return [*others, *(Effect("encoder_offset", name, {"offset": float(z)}) for name, z in own)]


def hidden_table(seed: int, content: dict[str, Any], details: Path) -> str:
  """Returns what the virtual robot hides beside what was found, in Markdown."""
  from nerf2real.real.virtual import motors
  from nerf2real.real.virtual.hidden import Hidden

  hidden = Hidden.draw(seed)
  duty = 800 / 128 * motors.COUNTS / (2 * np.pi) / motors.FULL_PWM  # per rad at a P gain of 800
  stall = motors.SPEED_CONSTANT * hidden.motors.battery_voltage / motors.RESISTANCE
  strength = duty * stall * hidden.motors.strength / constants.POSITION_GAIN
  calibration = json.loads(details.read_text())["calibration"]  # of joints whose constants stand
  rows = []
  for index, name in enumerate(constants.JOINT_NAMES):
    named = [e for e in content["effects"] if e["joint"] == name]
    own = {e["kind"]: e["parameters"] for e in named if not by_law(e)}
    share = own.pop("load_friction", {}).get("coefficient", {}).get("value")
    gain = own.pop("motor_gain", {}).get("gain", {}).get("value", 1.0)
    gain *= calibration.get(name, {}).get("gain", 1.0)  # that of the servo's law, too
    found = "not named" if share is None else f"{share:.2f}"
    gear = f"{hidden.motors.gear_share[index]:.2f}"
    other = ", ".join(own) or "-"
    rows.append((name, gear, found, f"{strength[index]:.2f}", f"{gain:.2f}", other))
  header = ("joint", "gear's share", "found", "strength", "found", "also named")
  lines = [
    "",
    "Share of the torque that the gear takes, and strength over the declared one (voltage law and",
    "battery included). Without a load strength cannot be told from all constants being smaller.",
    "",
    markdown.table(header, rows),
  ]
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
