"""Numbers of the Robotis OP3 humanoid, each with its source.

Paper: Byravan et al. 2022, NeRF2Real (https://arxiv.org/abs/2210.04932). Two things in it are to be
known when these numbers are used:

- Table "Joint reference poses and limits": the reference of the hip pitch (-0.5553 left, 0.5553
  right) lies outside its own range (-0.45..1.57 and -1.57..0.45), and so does the reference of the
  hip roll (-0.0383 in -0.4..-0.1 and mirrored). `REFERENCE_POSE` keeps the printed values, which
  the pose reward measures against; the servos' targets (`standing_targets`) are clipped to the
  ranges.
- Equation of r_pose: printed without a minus sign, although the text calls the term a
  regularisation towards the pose. `suite/tasks/rewards.py` implements a penalty (negative).
"""

import csv
import dataclasses
from importlib import resources

import numpy as np

# Joint: (reference pose, lower limit, upper limit) [rad]. Source: paper, appendix, table "Joint
# reference poses and limits", in the table's order, which is the order of actions and encoders.
_POSE_TABLE = {
  "head_pan": (0.043, -0.79, 0.79),
  "head_tilt": (-0.47, -0.79, -0.157),
  "l_ank_pitch": (0.638, -0.25, 1.109),
  "l_ank_roll": (-0.0414, -0.4, 0.4),
  "l_el": (-0.7915, -0.8, 0.2),
  "l_hip_pitch": (-0.5553, -0.45, 1.57),
  "l_hip_roll": (-0.0383, -0.4, -0.1),
  "l_hip_yaw": (0.0, -0.3, 0.3),
  "l_knee": (1.0646, -0.2, 2.0),
  "l_sho_pitch": (-0.0874, -0.785, 0.785),
  "l_sho_roll": (0.7915, 0.0, 0.8),
  "r_ank_pitch": (-0.638, -1.109, 0.25),
  "r_ank_roll": (0.0414, -0.4, 0.4),
  "r_el": (0.7915, -0.2, 0.8),
  "r_hip_pitch": (0.5553, -1.57, 0.45),
  "r_hip_roll": (0.0383, 0.1, 0.4),
  "r_hip_yaw": (0.0, -0.3, 0.3),
  "r_knee": (-1.0646, -2.0, 0.2),
  "r_sho_pitch": (0.0874, -0.785, 0.785),
  "r_sho_roll": (-0.7915, -0.8, 0.0),
}

JOINT_NAMES: tuple[str, ...] = tuple(_POSE_TABLE)
REFERENCE_POSE = np.array([row[0] for row in _POSE_TABLE.values()])  # [20] rad
LOWER_LIMITS = np.array([row[1] for row in _POSE_TABLE.values()])  # [20] rad
UPPER_LIMITS = np.array([row[2] for row in _POSE_TABLE.values()])  # [20] rad

BALL_PUSHING_HEAD_PAN = 2.5  # rad, both ways: in ball pushing (paper, "Control limits")

CONTROL_TIMESTEP = 0.025  # s: policies run at 40 Hz (paper, "Humanoid Robot platform")
ACTION_FILTER = 0.8  # strength of the exponential filter on the control signal (paper, same place)

# Servo: XM430-W350 in P-only position mode at 12 V.
POSITION_GAIN = 21.1  # N m/rad (public OP3 descriptions; 18.9 to 26.4 by the servo's voltage law)
JOINT_DAMPING = 1.084  # N m s/rad (public OP3 descriptions; nearly all of it is back-EMF)
ARMATURE = 0.045  # kg m^2 (public OP3 descriptions)
FRICTION_LOSS = 0.03  # N m (public OP3 descriptions)
TORQUE_LIMIT = 4.1  # N m: stall torque at 12 V (data sheet; public OP3 descriptions write 5)
ENCODER_STEP = 2 * np.pi / 4096  # rad: 12-bit encoder on the output (data sheet)
BUS_PERIOD = 0.008  # s: encoders and IMU are read at 125 Hz (paper; OP3's 8 ms cycle)

# Feet: two crossed boxes in each ankle-roll link (public OP3 descriptions): half size and position;
# y is the left foot's and changes sign on the right.
FOOT_BOXES = (
  ((0.0635, 0.028, 0.004), (0.024, 0.013, -0.0265)),
  ((0.057, 0.039, 0.004), (0.024, 0.0125, -0.0265)),
)

CAMERA_LINK = "head_tilt_link"
CAMERA_POSITION = (0.01425, -0.019, 0.04975)  # m in the head tilt link, looking along its +x
CAMERA_VERTICAL_FOV = np.deg2rad(43.3)  # rad

TORSO_LINK = "body_link"
# A robot has fallen below either; chosen: 60 degrees, little more than half the standing height.
MIN_UPRIGHT = 0.5  # cosine of the torso's tilt
MIN_HEIGHT = 0.14  # m of the torso's origin above the floor (standing: 0.246)
IMU_POSITION = (-0.01, 0.0, 0.05)  # m in the torso; chosen: near the OpenCR board
EXCLUDED_CONTACTS = (("l_hip_yaw_link", "l_hip_pitch_link"), ("r_hip_yaw_link", "r_hip_pitch_link"))
FOOT_LINKS = ("l_ank_roll_link", "r_ank_roll_link")


@dataclasses.dataclass(frozen=True)
class Link:
  """One rigid link; its frame is given in the parent link at zero joint angle (SI units)."""

  name: str
  parent: str
  """"world" for the torso."""
  position: np.ndarray
  """[3] m."""
  joint: str
  """"free" for the torso."""
  axis: np.ndarray
  """[3] unit vector in the link's frame."""
  mass: float
  """kg."""
  center: np.ndarray
  """Centre of mass [3] m."""
  inertia_quat: np.ndarray
  """[4] w x y z of the principal axes."""
  inertia: np.ndarray
  """Principal moments [3] kg m^2."""


def read_links() -> tuple[Link, ...]:
  """Reads the link table `links.csv` (values of ROBOTIS's public OP3 description)."""
  text = resources.files(__package__).joinpath("links.csv").read_text()
  rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))

  def numbers(row: dict[str, str], *keys: str) -> np.ndarray:
    return np.array([float(row[key]) for key in keys])

  return tuple(
    Link(
      name=row["link"],
      parent=row["parent"],
      position=numbers(row, "pos_x", "pos_y", "pos_z"),
      joint=row["joint"],
      axis=numbers(row, "axis_x", "axis_y", "axis_z"),
      mass=float(row["mass"]),
      center=numbers(row, "com_x", "com_y", "com_z"),
      inertia_quat=numbers(row, "iq_w", "iq_x", "iq_y", "iq_z"),
      inertia=numbers(row, "ixx", "iyy", "izz"),
    )
    for row in rows
  )


def joint_limits(*, head_pan: float | None = None) -> tuple[np.ndarray, np.ndarray]:
  """Returns the lower and upper control limits [20] [rad].

  Args:
    head_pan: If given, the head pan's limits are -head_pan and +head_pan [rad].
  """
  lower, upper = LOWER_LIMITS.copy(), UPPER_LIMITS.copy()
  if head_pan is not None:
    lower[JOINT_NAMES.index("head_pan")] = -head_pan
    upper[JOINT_NAMES.index("head_pan")] = head_pan
  return lower, upper


def standing_targets() -> np.ndarray:
  """Returns the reference pose clipped to the control limits [20] [rad]."""
  return np.clip(REFERENCE_POSE, LOWER_LIMITS, UPPER_LIMITS)
