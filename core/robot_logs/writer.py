"""Writes measured logs: MCAP files with ROS 2 messages, without ROS."""

import contextlib
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

from mcap.writer import CompressionType
from mcap_ros2.writer import Writer

from nerf2real.core.cameras import Camera
from nerf2real.core.robot_logs import messages

CHUNK_SIZE = 64 * 1024
"""Bytes before compression; ours: what a power cut may lose, a second of 20 joints."""


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
    self._write(
      messages.joint_state(
        messages.COMMANDS, stamp_ns, self._joints, position=position, effort=effort
      ),
      stamp_ns,
      log_ns,
    )

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
    self._write(
      messages.joint_state(
        messages.STATES, stamp_ns, self._joints, position=position, velocity=velocity, effort=effort
      ),
      stamp_ns,
      log_ns,
    )

  def pwm(self, stamp_ns: int, duty: Sequence[float], *, log_ns: int | None = None) -> None:
    """Writes the motors' measured duty, -1 to 1."""
    message = messages.joint_state(messages.PWM, stamp_ns, self._joints, effort=duty)
    self._write(message, stamp_ns, log_ns)

  def battery(self, stamp_ns: int, voltage: float, *, log_ns: int | None = None) -> None:
    """Writes the supply's voltage, V; what is not measured is NaN, as ROS defines it."""
    self._write(messages.battery(stamp_ns, voltage), stamp_ns, log_ns)

  def temperature(
    self, stamp_ns: int, joint: str, celsius: float, *, log_ns: int | None = None
  ) -> None:
    """Writes a servo's temperature, degrees Celsius."""
    self._write(messages.temperature(stamp_ns, joint, celsius), stamp_ns, log_ns)

  def imu(
    self,
    stamp_ns: int,
    *,
    angular_velocity: Sequence[float],
    linear_acceleration: Sequence[float],
    frame: str = messages.IMU_FRAME,
    log_ns: int | None = None,
  ) -> None:
    """Writes turning rates [rad/s] and accelerations [m/s2] in the sensor's frame."""
    message = messages.imu(stamp_ns, angular_velocity, linear_acceleration, frame=frame)
    self._write(message, stamp_ns, log_ns)

  def picture(self, stamp_ns: int, jpeg: bytes, *, log_ns: int | None = None) -> None:
    """Writes a JPEG picture; the stamp is when it was taken, as far as the machine knows."""
    self._write(messages.image(stamp_ns, jpeg), stamp_ns, log_ns)

  def lens(self, stamp_ns: int, camera: Camera, *, log_ns: int | None = None) -> None:
    """Writes the camera's calibrated lens."""
    self._write(messages.camera_info(stamp_ns, camera), stamp_ns, log_ns)

  def _write(self, message: messages.Message, stamp_ns: int, log_ns: int | None) -> None:
    topic, schema, fields = message
    if schema not in self._schemas:
      self._schemas[schema] = self._writer.register_msgdef(schema, messages.DEFINITIONS[schema])
    sequence = self._sequence.get(topic, 0)
    self._sequence[topic] = sequence + 1
    moment = int(stamp_ns if log_ns is None else log_ns)
    self._writer.write_message(
      topic=topic,
      schema=self._schemas[schema],
      message=fields,
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
