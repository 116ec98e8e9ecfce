"""Motions that excite a robot for identification, and the models that they are fitted with.

Shapes: T control steps, 20 joints.
"""

import mujoco
import numpy as np

from nerf2real.evaluation.loop.settings import HELD, TRAIN
from nerf2real.suite.op3 import constants
from nerf2real.suite.op3.op3 import OP3

STANDING = "sway"
_KINDS = (*TRAIN, *HELD, STANDING)
_STEP = constants.CONTROL_TIMESTEP
_RAMP = 1.5  # s from the standing pose to a motion
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


def standing_model() -> mujoco.MjModel:
  """Returns the suite's OP3, free, on a plane."""
  spec = mujoco.MjSpec.from_string(OP3().mjcf_model.to_xml_string())
  spec.body(constants.TORSO_LINK).add_freejoint()
  spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1])
  return spec.compile()


def motion(kind: str, count: int) -> np.ndarray:
  """Returns actions [T, 20] about the standing pose.

  Args:
    kind: "sweep", "slow", "steps", "mixed" or "sway".
    count: control steps T.
  """
  rng = np.random.default_rng([3, _KINDS.index(kind)])
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
  if kind != STANDING:  # all of the reach lies within the limits
    centre = np.clip(standing, lower + reach, np.maximum(upper - reach, lower + reach))
  targets = standing + away * (centre - standing + reach * wave)
  middle, half = (lower + upper) / 2, (upper - lower) / 2
  return np.clip((targets - middle) / half, -1, 1).astype(np.float32)
