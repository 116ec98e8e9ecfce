"""The OP3's servos in one table: id, direction and offset of every joint, and the units of the bus.

Ids: ROBOTIS-GIT/ROBOTIS-OP3, `OP3.robot`. Directions: ROBOTIS's framework has none, because the
axes of its robot description (`suite/op3/links.csv`) point the way each servo turns; a servo that
was mounted the other way gets -1 here. Offsets: a robot's own, from its `offset.yaml`
(`read_offsets`).

  counts = 2048 + direction * (angle + offset) * 4096 / (2 pi)
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.suite.op3 import constants

CENTER = 2048  # counts at angle + offset = 0: OP3's home position
RADIANS_PER_COUNT = 2 * np.pi / 4096
SPEED_UNIT = 0.229 * 2 * np.pi / 60  # rad/s, XM430 velocity register
CURRENT_UNIT = 0.00269  # A, XM430 current register
VOLTAGE_UNIT = 0.1  # V, XM430 and OpenCR voltage registers
PWM_UNIT = 1 / 885  # share of the supply voltage, XM430 PWM register
BOARD_ID = 200  # OpenCR
_MAX_OFFSET = 0.3  # rad: a larger one is a servo horn on a wrong tooth (0.26 rad) or a wrong unit


class Joint(NamedTuple):
  """How one joint is wired."""

  name: str
  device: int  # id on the bus
  direction: int  # 1 or -1
  offset: float  # rad, added to the joint's angle before it goes to the servo


JOINTS: tuple[Joint, ...] = (
  Joint("head_pan", 19, 1, 0.0),
  Joint("head_tilt", 20, 1, 0.0),
  Joint("l_ank_pitch", 16, 1, 0.0),
  Joint("l_ank_roll", 18, 1, 0.0),
  Joint("l_el", 6, 1, 0.0),
  Joint("l_hip_pitch", 12, 1, 0.0),
  Joint("l_hip_roll", 10, 1, 0.0),
  Joint("l_hip_yaw", 8, 1, 0.0),
  Joint("l_knee", 14, 1, 0.0),
  Joint("l_sho_pitch", 2, 1, 0.0),
  Joint("l_sho_roll", 4, 1, 0.0),
  Joint("r_ank_pitch", 15, 1, 0.0),
  Joint("r_ank_roll", 17, 1, 0.0),
  Joint("r_el", 5, 1, 0.0),
  Joint("r_hip_pitch", 11, 1, 0.0),
  Joint("r_hip_roll", 9, 1, 0.0),
  Joint("r_hip_yaw", 7, 1, 0.0),
  Joint("r_knee", 13, 1, 0.0),
  Joint("r_sho_pitch", 1, 1, 0.0),
  Joint("r_sho_roll", 3, 1, 0.0),
)  # in the order of `suite.op3.constants.JOINT_NAMES`


@dataclasses.dataclass(frozen=True)
class Wiring:
  """The table as arrays, in the order of `constants.JOINT_NAMES`. J joints."""

  joints: tuple[Joint, ...] = JOINTS
  """One of each joint."""

  def __post_init__(self):
    names = tuple(joint.name for joint in self.joints)
    if names != constants.JOINT_NAMES:
      raise ValueError(f"Joints must be in the order {constants.JOINT_NAMES}, found {names}.")

  @property
  def ids(self) -> tuple[int, ...]:
    """Ids on the bus [J]."""
    return tuple(joint.device for joint in self.joints)

  @property
  def directions(self) -> np.ndarray:
    """Directions [J]."""
    return np.array([joint.direction for joint in self.joints])

  @property
  def offsets(self) -> np.ndarray:
    """Offsets [J] [rad]."""
    return np.array([joint.offset for joint in self.joints])

  def to_counts(self, angles: np.ndarray) -> np.ndarray:
    """Returns servo positions [J] of joint angles [J] [rad]."""
    turned = self.directions * (np.asarray(angles) + self.offsets)
    return np.rint(CENTER + turned / RADIANS_PER_COUNT).astype(np.int64)

  def to_angles(self, counts: np.ndarray) -> np.ndarray:
    """Returns joint angles [J] [rad] of servo positions [J]."""
    turned = (np.asarray(counts) - CENTER) * RADIANS_PER_COUNT
    return self.directions * turned - self.offsets

  def name_of(self, device: int) -> str:
    """Returns the name of the device with an id."""
    names = {joint.device: joint.name for joint in self.joints}
    return names.get(device, "OpenCR" if device == BOARD_ID else "unknown")


def read_offsets(path: Path | str) -> Wiring:
  """Reads a robot's offsets from a file of ROBOTIS's offset tuner (`offset: {joint: rad}`).

  Raises:
    ValueError: The file holds something else; the message names it.
  """
  import yaml

  try:
    found = yaml.safe_load(Path(path).read_text())["offset"]
    offsets = {str(name): float(value) for name, value in found.items()}
  except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
    raise ValueError(
      f"{path} holds no joint offsets ({type(error).__name__}): expected `offset:` with a number "
      "[rad] for each joint."
    ) from error
  unknown = sorted(set(offsets) - set(constants.JOINT_NAMES))
  if unknown:
    raise ValueError(f"{path} has offsets of unknown joints {unknown}.")
  large = {name: value for name, value in offsets.items() if not abs(value) <= _MAX_OFFSET}
  if large:
    raise ValueError(f"{path} has offsets beyond +-{_MAX_OFFSET} rad: {large}. Check the units.")
  return Wiring(
    tuple(joint._replace(offset=offsets.get(joint.name, joint.offset)) for joint in JOINTS)
  )
