"""Writes measured logs: MCAP files with ROS 2 messages, without ROS."""

import contextlib
import math
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

from mcap.writer import CompressionType
from mcap_ros2.writer import Writer

from sysid import logs

TEMPERATURE = "/joint_temperature"

CHUNK_SIZE = 64 * 1024
"""Bytes before compression; ours: what a power cut may lose, a second of 20 joints."""

_SEPARATOR = "=" * 80 + "\n"
_HEADER = f"""{_SEPARATOR}MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_SEPARATOR}MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_VECTORS = f"""{_SEPARATOR}MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_SEPARATOR}MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
# The definitions of ROS 2's sensor_msgs, field by field.
DEFINITIONS = {
  "sensor_msgs/msg/JointState": f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
  "sensor_msgs/msg/Imu": f"""std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{_VECTORS}{_HEADER}""",
  "sensor_msgs/msg/BatteryState": f"""std_msgs/Header header
float32 voltage
float32 temperature
float32 current
float32 charge
float32 capacity
float32 design_capacity
float32 percentage
uint8 power_supply_status
uint8 power_supply_health
uint8 power_supply_technology
bool present
float32[] cell_voltage
float32[] cell_temperature
string location
string serial_number
{_HEADER}""",
  "sensor_msgs/msg/Temperature": f"""std_msgs/Header header
float64 temperature
float64 variance
{_HEADER}""",
}


class LogWriter:
  """One log being written. Times are integers, ns; `log_ns` defaults to the header stamp.

  Messages must come in the order of time within a topic.
  """

  def __init__(self, writer: Writer, joints: Sequence[str]):
    self._writer = writer
    self._joints = list(joints)
    self._schemas: dict[str, Any] = {}
    self._sequence: dict[str, int] = {}

  def command(
    self,
    stamp_ns: int,
    *,
    position: Sequence[float] = (),
    effort: Sequence[float] = (),
    log_ns: int | None = None,
  ) -> None:
    """Writes what the actuators are told: positions or efforts, one a joint."""
    fields = {"name": self._joints, "position": list(position), "effort": list(effort)}
    self._write(logs.COMMANDS, "sensor_msgs/msg/JointState", stamp_ns, log_ns, "", fields)

  def state(
    self,
    stamp_ns: int,
    *,
    position: Sequence[float],
    velocity: Sequence[float] = (),
    effort: Sequence[float] = (),
    log_ns: int | None = None,
  ) -> None:
    """Writes what the encoders read; efforts are measured torques, N m or N."""
    fields = {
      "name": self._joints,
      "position": list(position),
      "velocity": list(velocity),
      "effort": list(effort),
    }
    self._write(logs.STATES, "sensor_msgs/msg/JointState", stamp_ns, log_ns, "", fields)

  def pwm(self, stamp_ns: int, duty: Sequence[float], *, log_ns: int | None = None) -> None:
    """Writes the motors' measured duty, -1 to 1."""
    fields = {"name": self._joints, "effort": list(duty)}
    self._write(logs.PWM, "sensor_msgs/msg/JointState", stamp_ns, log_ns, "", fields)

  def battery(self, stamp_ns: int, voltage: float, *, log_ns: int | None = None) -> None:
    """Writes the supply's voltage, V; what is not measured is NaN, as ROS defines it."""
    unknown = dict.fromkeys(
      ("temperature", "current", "charge", "capacity", "design_capacity", "percentage"), math.nan
    )
    fields = {"voltage": float(voltage), "present": True, **unknown}
    self._write(logs.BATTERY, "sensor_msgs/msg/BatteryState", stamp_ns, log_ns, "", fields)

  def temperature(
    self, stamp_ns: int, joint: str, celsius: float, *, log_ns: int | None = None
  ) -> None:
    """Writes a servo's temperature, degrees Celsius."""
    fields = {"temperature": float(celsius), "variance": 0.0}
    self._write(TEMPERATURE, "sensor_msgs/msg/Temperature", stamp_ns, log_ns, joint, fields)

  def imu(
    self,
    stamp_ns: int,
    *,
    angular_velocity: Sequence[float],
    linear_acceleration: Sequence[float],
    frame: str = "imu",
    log_ns: int | None = None,
  ) -> None:
    """Writes turning rates [rad/s] and accelerations [m/s2] in the sensor's frame."""
    fields = {
      "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
      # By the message's definition -1 says that the orientation is not measured.
      "orientation_covariance": [-1.0, *[0.0] * 8],
      "angular_velocity": dict(zip("xyz", map(float, angular_velocity), strict=True)),
      "angular_velocity_covariance": [0.0] * 9,
      "linear_acceleration": dict(zip("xyz", map(float, linear_acceleration), strict=True)),
      "linear_acceleration_covariance": [0.0] * 9,
    }
    self._write(logs.IMU, "sensor_msgs/msg/Imu", stamp_ns, log_ns, frame, fields)

  def _write(
    self,
    topic: str,
    schema: str,
    stamp_ns: int,
    log_ns: int | None,
    frame: str,
    fields: dict[str, Any],
  ) -> None:
    if schema not in self._schemas:
      self._schemas[schema] = self._writer.register_msgdef(schema, DEFINITIONS[schema])
    stamp_ns = int(stamp_ns)
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    header = {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}
    sequence = self._sequence.get(topic, 0)
    self._sequence[topic] = sequence + 1
    moment = stamp_ns if log_ns is None else int(log_ns)
    self._writer.write_message(
      topic=topic,
      schema=self._schemas[schema],
      message={"header": header, **fields},
      log_time=moment,
      publish_time=moment,
      sequence=sequence,
    )


@contextlib.contextmanager
def open_log(path: str | pathlib.Path, joints: Sequence[str]) -> Iterator[LogWriter]:
  """Opens a log for writing; the file is complete when the context ends.

  Args:
    path: the file to make; its folder is made too.
    joints: names of the joints, in the order of all values.
  """
  path = pathlib.Path(path)
  path.parent.mkdir(parents=True, exist_ok=True)
  with path.open("wb") as stream:
    writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD)
    try:
      yield LogWriter(writer, joints)
    finally:
      writer.finish()
