"""The ROS 2 messages of a measured log, built without ROS: definitions, topics and dictionaries.

Definitions are those of ROS 2's sensor_msgs, std_msgs, geometry_msgs and builtin_interfaces, field
by field, without constants. They are kept here because a library that holds all of ROS (rosbags'
typesys) adds 0.1 s to the 0.16 s in which the recorder's process starts. Times are nanoseconds
since 1970. Every function returns (topic, type, fields).
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.core.geometry.cameras import Camera

COMMANDS, STATES = "/joint_commands", "/joint_states"
PWM, CURRENTS, VOLTAGES = "/joint_pwm", "/joint_currents", "/joint_voltages"
STAMPS = "/joint_stamps"
IMU, GRAVITY = "/imu/data_raw", "/imu/gravity"
IMAGE, CAMERA_INFO = "/camera/image_raw/compressed", "/camera/camera_info"
BATTERY, TEMPERATURE = "/battery_state", "/joint_temperature"
IMU_FRAME, CAMERA_FRAME = "imu", "camera"

JOINT_STATE, IMU_TYPE = "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
VECTOR_STAMPED = "geometry_msgs/msg/Vector3Stamped"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
BATTERY_TYPE, TEMPERATURE_TYPE = "sensor_msgs/msg/BatteryState", "sensor_msgs/msg/Temperature"


Message = tuple[str, str, dict[str, Any]]


SECOND = 1_000_000_000  # ns
# Type: fields, as in ROS 2's packages (a test compares them with a ROS typestore).
_FIELDS = {
  "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
  "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
  "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
  "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
  "geometry_msgs/Vector3Stamped": "std_msgs/Header header, geometry_msgs/Vector3 vector",
  "sensor_msgs/RegionOfInterest": (
    "uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, bool do_rectify"
  ),
  "sensor_msgs/JointState": (
    "std_msgs/Header header, string[] name, float64[] position, float64[] velocity, "
    "float64[] effort"
  ),
  "sensor_msgs/Imu": (
    "std_msgs/Header header, "
    "geometry_msgs/Quaternion orientation, float64[9] orientation_covariance, "
    "geometry_msgs/Vector3 angular_velocity, float64[9] angular_velocity_covariance, "
    "geometry_msgs/Vector3 linear_acceleration, float64[9] linear_acceleration_covariance"
  ),
  "sensor_msgs/CompressedImage": "std_msgs/Header header, string format, uint8[] data",
  "sensor_msgs/CameraInfo": (
    "std_msgs/Header header, uint32 height, uint32 width, string distortion_model, float64[] d, "
    "float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, uint32 binning_y, "
    "sensor_msgs/RegionOfInterest roi"
  ),
  "sensor_msgs/BatteryState": (
    "std_msgs/Header header, float32 voltage, float32 temperature, float32 current, "
    "float32 charge, float32 capacity, float32 design_capacity, float32 percentage, "
    "uint8 power_supply_status, uint8 power_supply_health, uint8 power_supply_technology, "
    "bool present, float32[] cell_voltage, float32[] cell_temperature, string location, "
    "string serial_number"
  ),
  "sensor_msgs/Temperature": "std_msgs/Header header, float64 temperature, float64 variance",
}


def definition(kind: str) -> str:
  """Returns the definition of a message type, followed by those of the types in it.

  Args:
    kind: Such as "sensor_msgs/msg/JointState".
  """
  name = kind.replace("/msg/", "/")
  parts = [f"MSG: {part}\n{_lines(part)}" for part in _parts(name)]
  return f"\n{'=' * 80}\n".join([_lines(name), *parts]) + "\n"


def _lines(name: str) -> str:
  return _FIELDS[name].replace(", ", "\n")


def _parts(name: str) -> list[str]:
  """Returns the types in a type, each once, before the types in them."""
  found: dict[str, None] = {}
  for field in _FIELDS[name].split(", "):
    part = field.split(" ")[0]
    if part in _FIELDS:
      found |= dict.fromkeys([part, *_parts(part)])
  return list(found)


def header(time_ns: int, frame: str = "") -> dict[str, Any]:
  """Returns a std_msgs/Header."""
  seconds, nanoseconds = divmod(int(time_ns), SECOND)
  return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def joint_state(
  time_ns: int,
  topic: str,
  names: Sequence[str],
  *,
  position: Sequence[float] | None = None,
  velocity: Sequence[float] | None = None,
  effort: Sequence[float] | None = None,
) -> Message:
  """Returns a JointState; fields that are not given stay empty."""

  def numbers(values: Sequence[float] | None) -> list[float]:
    return [] if values is None else np.asarray(values, np.float64).ravel().tolist()

  fields = {
    "header": header(time_ns),
    "name": list(names),
    "position": numbers(position),
    "velocity": numbers(velocity),
    "effort": numbers(effort),
  }
  return topic, JOINT_STATE, fields


def _vector(values: Sequence[float]) -> dict[str, float]:
  x, y, z = (float(value) for value in values)
  return {"x": x, "y": y, "z": z}


def imu(
  time_ns: int,
  gyroscope: Sequence[float],
  accelerometer: Sequence[float],
  *,
  frame: str = IMU_FRAME,
) -> Message:
  """Returns turning rates [3] [rad/s] and specific force [3] [m/s^2]; there is no orientation."""
  unknown = [-1.0] + 8 * [0.0]  # sensor_msgs: -1 first stands for none
  fields = {
    "header": header(time_ns, frame),
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    "orientation_covariance": unknown,
    "angular_velocity": _vector(gyroscope),
    "angular_velocity_covariance": 9 * [0.0],
    "linear_acceleration": _vector(accelerometer),
    "linear_acceleration_covariance": 9 * [0.0],
  }
  return IMU, IMU_TYPE, fields


def gravity(time_ns: int, direction: Sequence[float]) -> Message:
  """Returns the estimated direction of gravity [3] in the torso's frame."""
  fields = {"header": header(time_ns, IMU_FRAME), "vector": _vector(direction)}
  return GRAVITY, VECTOR_STAMPED, fields


def image(time_ns: int, jpeg: bytes) -> Message:
  """Returns a JPEG picture."""
  fields = {"header": header(time_ns, CAMERA_FRAME), "format": "jpeg", "data": jpeg}
  return IMAGE, COMPRESSED_IMAGE, fields


def camera_info(time_ns: int, camera: Camera) -> Message:
  """Returns a lens in ROS's pixel convention."""
  matrix = camera.opencv_matrix
  fields = {
    "header": header(time_ns, CAMERA_FRAME),
    "height": camera.height,
    "width": camera.width,
    "distortion_model": "plumb_bob",
    "d": [*camera.distortion.tolist(), 0.0],
    "k": matrix.ravel().tolist(),
    "r": np.eye(3).ravel().tolist(),
    "p": np.hstack([matrix, np.zeros((3, 1))]).ravel().tolist(),
    "binning_x": 0,
    "binning_y": 0,
    "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
  }
  return CAMERA_INFO, CAMERA_INFO_TYPE, fields


def battery(time_ns: int, voltage: float) -> Message:
  """Returns the supply's voltage [V]; what is not measured is NaN, as ROS defines it."""
  unknown = ("temperature", "current", "charge", "capacity", "design_capacity", "percentage")
  fields = {
    "header": header(time_ns),
    "voltage": float(voltage),
    **dict.fromkeys(unknown, math.nan),
    "power_supply_status": 0,
    "power_supply_health": 0,
    "power_supply_technology": 0,
    "present": True,
    "cell_voltage": [],
    "cell_temperature": [],
    "location": "",
    "serial_number": "",
  }
  return BATTERY, BATTERY_TYPE, fields


def temperature(time_ns: int, joint: str, celsius: float) -> Message:
  """Returns a servo's temperature [degrees Celsius]; the frame names the joint."""
  fields = {"header": header(time_ns, joint), "temperature": float(celsius), "variance": 0.0}
  return TEMPERATURE, TEMPERATURE_TYPE, fields
