"""The OpenCR board of an OP3: its registers, and what the IMU's numbers mean.

Sources: ROBOTIS-GIT/OpenCR, OP3 example, `dxl_node_op3.h` (addresses); ROBOTIS-GIT/ROBOTIS-OP3,
`open_cr_module` (scales, and that the chip's x and y point against the robot's).
"""

import struct
from typing import NamedTuple

import numpy as np

POWER = 24  # 1: the servos have power
MEASURED, MEASURED_LENGTH = 31, 13  # supply voltage, gyroscope, accelerometer
GRAVITY = 9.80665  # m/s^2
_LAYOUT = struct.Struct("<B6h")
_GYROSCOPE_UNIT = np.deg2rad(2000 / 32800)  # rad/s
_ACCELEROMETER_UNIT = 2 * GRAVITY / 32768  # m/s^2: full scale is 2 g
_BODY_FROM_CHIP = np.array([-1.0, -1.0, 1.0])
_VOLTAGE_UNIT = 0.1  # V


class ImuReading(NamedTuple):
  """One reading of the board, in the axes of the robot's torso (x forward, y left, z up)."""

  stamp: float  # s
  gyroscope: np.ndarray  # [3] rad/s
  accelerometer: np.ndarray  # [3] specific force, m/s^2
  voltage: float  # V of the supply


def decode(stamp: float, data: bytes) -> ImuReading:
  """Decodes the 13 bytes from address 31 on, taken at a time [s]."""
  volts, *counts = _LAYOUT.unpack(data)
  values = np.array(counts, np.float64).reshape(2, 3) * _BODY_FROM_CHIP
  return ImuReading(
    stamp, values[0] * _GYROSCOPE_UNIT, values[1] * _ACCELEROMETER_UNIT, volts * _VOLTAGE_UNIT
  )
