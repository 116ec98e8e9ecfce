"""Inverse kinematics of the OP3's legs, exact for its link table.

Hip yaw and roll axes meet, hip pitch lies in the roll axis's plane, and the sideways offsets of hip
pitch and ankle roll cancel: a leg is a spherical hip, a knee and a universal ankle. Angles follow
the right-hand rule about x (forward), y (left) and z (up); a knee that bends is positive.
"""

import numpy as np

from nerf2real.suite.op3 import constants

THIGH, SHANK = 0.11015, 0.11  # m (links.csv, knee_link and ank_pitch_link)
SIDES = (1.0, -1.0)  # left, right: sign of y
_JOINTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ank_pitch", "ank_roll")
# Sign of a joint's direction against the right-hand rule (links.csv, axis), left and right.
_SIGNS = {"l": (-1, -1, 1, 1, -1, 1), "r": (-1, -1, -1, -1, 1, 1)}
COLUMNS = np.array(
  [[constants.JOINT_NAMES.index(f"{side}_{joint}") for joint in _JOINTS] for side in "lr"]
)  # [2, 6] of the legs' joints in an action
_REACH = (0.06, 0.99 * (THIGH + SHANK))  # m: how short and how long a leg may get


def leg_angles(ankle: np.ndarray, *, foot_roll: float, foot_pitch: float, yaw: float) -> np.ndarray:
  """Returns the angles of one leg for a place of its ankle.

  Args:
    ankle: Ankle relative to the hip's centre [3] in the torso's frame [m]; a place out of reach is
      drawn to the nearest distance within reach.
    foot_roll: Roll of the foot against the torso [rad].
    foot_pitch: Pitch of the foot against the torso [rad].
    yaw: Heading of the leg against the torso [rad].

  Returns:
    Hip yaw, hip roll, hip pitch, knee, ankle pitch, ankle roll [6] [rad], right-hand rule.
  """
  cosine, sine = np.cos(yaw), np.sin(yaw)
  x, y = cosine * ankle[0] + sine * ankle[1], cosine * ankle[1] - sine * ankle[0]
  roll = np.arctan2(y, -ankle[2])
  depth = np.hypot(y, ankle[2])
  length = float(np.clip(np.hypot(x, depth), *_REACH))
  bend = np.arccos((length**2 - THIGH**2 - SHANK**2) / (2 * THIGH * SHANK))
  lead = np.arccos((THIGH**2 + length**2 - SHANK**2) / (2 * THIGH * length))
  pitch = -np.arctan2(x, depth) - lead
  return np.array([yaw, roll, pitch, bend, foot_pitch - pitch - bend, foot_roll - roll])


def joint_positions(left: np.ndarray, right: np.ndarray) -> np.ndarray:
  """Turns both legs' angles [6] into joint positions [2, 6] at `COLUMNS` of an action [rad]."""
  return np.stack([left * _SIGNS["l"], right * _SIGNS["r"]])
