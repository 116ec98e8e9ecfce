"""Measured logs: MCAP files with ROS 2 messages, read into arrays.

N messages of a topic, J joints. Times are seconds from the first stamp in the file; `stamp` is the
message's header stamp, `log_time` the moment it was written down, on the same zero.
"""

import dataclasses
import pathlib
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import mujoco
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

COMMANDS = "/joint_commands"
STATES = "/joint_states"
PWM = "/joint_pwm"
IMU = "/imu/data_raw"
BATTERY = "/battery_state"
TEMPERATURE_TYPE = "sensor_msgs/msg/Temperature"
"""Temperatures are found by type: the topic's name is free, frame_id names the joint."""

MINIMUM_DURATION = 1.0
"""s; ours: a shorter log holds not one period of the slowest excitation of a servo joint."""

_NANO = 1e-9

# What the parsers of MCAP, of its two compressions and of ROS messages raise on damaged bytes.
_DAMAGE = (
  *(McapError, zstandard.ZstdError, struct.error, EOFError),
  *(ValueError, KeyError, IndexError, RuntimeError, MemoryError, OverflowError),
)


class LogError(ValueError):
  """A log that cannot be used: one line with what was found, what was expected, what to do."""


@dataclasses.dataclass(frozen=True)
class JointSeries:
  """Messages of sensor_msgs/JointState; a field that the messages leave empty is None."""

  joints: tuple[str, ...]
  """J names, in the order of the columns."""
  stamp: np.ndarray
  """[N] s."""
  log_time: np.ndarray
  """[N] s."""
  position: np.ndarray | None
  """[N, J] rad or m."""
  velocity: np.ndarray | None
  """[N, J] rad/s or m/s."""
  effort: np.ndarray | None
  """[N, J] N m or N; of `/joint_pwm` the duty, -1 to 1."""

  def column(self, joint: str) -> int:
    """Returns the column of a joint."""
    return self.joints.index(joint)


@dataclasses.dataclass(frozen=True)
class ImuSeries:
  """Messages of sensor_msgs/Imu: the raw rates and accelerations."""

  stamp: np.ndarray
  log_time: np.ndarray
  angular_velocity: np.ndarray
  """[N, 3] rad/s."""
  linear_acceleration: np.ndarray
  """[N, 3] m/s2."""
  frame: str


@dataclasses.dataclass(frozen=True)
class ScalarSeries:
  """One number over time: a voltage [V] or a temperature [degrees Celsius]."""

  stamp: np.ndarray
  log_time: np.ndarray
  value: np.ndarray


@dataclasses.dataclass(frozen=True)
class Log:
  """One measured log."""

  name: str
  start_ns: int
  """The first header stamp, ns since 1970: zero of all times here."""
  commands: JointSeries
  states: JointSeries
  pwm: JointSeries | None
  imu: ImuSeries | None
  battery: ScalarSeries | None
  temperatures: dict[str, ScalarSeries]
  """By joint."""
  recovered: bool = False
  """The file was damaged and this is what could be read of it."""

  @property
  def joints(self) -> tuple[str, ...]:
    """The joints whose states were measured."""
    return self.states.joints

  @property
  def duration(self) -> float:
    """Seconds that commands and states cover together."""
    first = max(self.commands.stamp[0], self.states.stamp[0])
    return float(min(self.commands.stamp[-1], self.states.stamp[-1]) - first)


@dataclasses.dataclass
class _Topic:
  """The decoded messages of one topic in the order of the file."""

  name: str
  schema: str
  stamp_ns: list[int] = dataclasses.field(default_factory=list)
  log_ns: list[int] = dataclasses.field(default_factory=list)
  messages: list[Any] = dataclasses.field(default_factory=list)


def read_log(path: str | pathlib.Path, *, recover: bool = False) -> Log:
  """Reads a measured log.

  Args:
    path: an MCAP file with at least `/joint_commands` and `/joint_states`.
    recover: read what is readable of a damaged file instead of raising; whole chunks only.

  Raises:
    FileNotFoundError: no such file.
    LogError: not an MCAP, damaged, without commands or states, with NaNs, with time running
      backwards, or shorter than `MINIMUM_DURATION`.
  """
  path = pathlib.Path(path)
  if not path.is_file():
    raise FileNotFoundError(f"Found no file {path}, expected a measured log (.mcap).")
  topics, damaged = _read_topics(path, recover)
  for topic in topics.values():
    _check_time(path.name, topic)
  for name, holds in ((COMMANDS, "commands"), (STATES, "states")):
    if name not in topics:
      raise LogError(
        f"{path.name} has no {holds}: expected messages on {name}, found the topics "
        f"{sorted(topics) or 'none'}; record that topic too."
      )
  start = min(min(topic.stamp_ns) for topic in topics.values())
  commands = _joint_series(path.name, topics[COMMANDS], start)
  states = _joint_series(path.name, topics[STATES], start)
  if commands.position is None and commands.effort is None:
    raise LogError(
      f"{path.name} has no commands: {COMMANDS} holds neither positions nor efforts in its "
      f"{len(commands.stamp)} messages; record what the actuators are told."
    )
  if states.position is None:
    raise LogError(f"{path.name} has no positions in {STATES}: record the joints' positions.")
  log = Log(
    name=path.name,
    start_ns=start,
    commands=commands,
    states=states,
    pwm=_joint_series(path.name, topics[PWM], start) if PWM in topics else None,
    imu=_imu(path.name, topics[IMU], start) if IMU in topics else None,
    battery=_battery(topics[BATTERY], start) if BATTERY in topics else None,
    temperatures=_temperatures(topics.values(), start),
    recovered=damaged,
  )
  if log.duration < MINIMUM_DURATION:
    raise LogError(
      f"{path.name} lasts {max(log.duration, 0.0):.3g} s with commands and states, expected at "
      f"least {MINIMUM_DURATION:g} s: record a longer log."
    )
  return log


def check_against_model(log: Log, model: mujoco.MjModel) -> None:
  """Raises a LogError where a model has not the joints and actuators that a log speaks of."""
  names = [model.joint(index).name for index in range(model.njnt)]
  missing = [name for name in dict.fromkeys(log.commands.joints + log.joints) if name not in names]
  if missing:
    raise LogError(
      f"{log.name} has the joints {missing} that the model lacks: it has {names}; give the model "
      "of this apparatus, or the log's joints the model's names."
    )
  unmeasured = [name for name in log.commands.joints if name not in log.joints]
  if unmeasured:
    raise LogError(
      f"{log.name} commands {unmeasured} but {STATES} has no such joints: record their positions."
    )
  joint_transmission = int(mujoco.mjtTrn.mjTRN_JOINT)
  driven = {
    names[model.actuator_trnid[index, 0]]: index
    for index in range(model.nu)
    if model.actuator_trntype[index] == joint_transmission
  }
  for name in log.commands.joints:
    kind = int(model.joint(name).type[0])
    if kind not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
      raise LogError(f"{log.name} commands {name!r}, in the model neither a hinge nor a slide.")
    if name not in driven:
      raise LogError(
        f"{log.name} commands {name!r}, but no actuator of the model drives that joint: it drives "
        f"{sorted(driven)}."
      )
    takes = "position" if model.actuator_biasprm[driven[name], 1] != 0.0 else "effort"
    if getattr(log.commands, takes) is None:
      raise LogError(
        f"{log.name} has no {takes}s in {COMMANDS}, which the model's actuator on {name!r} takes: "
        f"record {takes}s, or give a model with the actuator that was driven."
      )


def _read_topics(path: pathlib.Path, recover: bool) -> tuple[dict[str, _Topic], bool]:
  """Returns the known topics with messages, and whether the file was damaged."""
  topics: dict[str, _Topic] = {}
  decoders = DecoderFactory()
  known: dict[int, Callable[[bytes], Any] | None] = {}
  channels: dict[int, Channel] = {}
  schemas: dict[int, Schema] = {}
  try:
    with path.open("rb") as stream:
      for record in StreamReader(stream, validate_crcs=True).records:
        if isinstance(record, Schema):
          schemas[record.id] = record
        elif isinstance(record, Channel):
          channels[record.id] = record
        elif isinstance(record, Message):
          channel = channels[record.channel_id]
          schema = schemas[channel.schema_id]
          if channel.id not in known:
            wanted = channel.topic in (COMMANDS, STATES, PWM, IMU, BATTERY)
            wanted = wanted or schema.name == TEMPERATURE_TYPE
            known[channel.id] = (
              decoders.decoder_for(channel.message_encoding, schema) if wanted else None
            )
          decode = known[channel.id]
          if decode is not None:
            topic = topics.setdefault(channel.topic, _Topic(channel.topic, schema.name))
            _append(topic, record, decode(record.data))
  except _DAMAGE as error:
    if not recover:
      raise LogError(_damage(path, error, topics)) from error
    return topics, True
  return topics, False


def _append(topic: _Topic, record: Message, message: Any) -> None:
  stamp = message.header.stamp
  # A driver that leaves the stamp empty means: the moment of writing.
  stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec or record.log_time
  topic.stamp_ns.append(stamp_ns)
  topic.log_ns.append(record.log_time)
  topic.messages.append(message)


def _damage(path: pathlib.Path, error: Exception, topics: dict[str, _Topic]) -> str:
  """Returns the message for a file that cannot be read to its end."""
  with path.open("rb") as stream:
    head = stream.read(5)
  if not head:
    return f"{path.name} is empty, expected an MCAP file: record it again."
  if not b"\x89MCAP".startswith(head):
    return f"{path.name} is not an MCAP file: it starts with {head!r}, expected b'\\x89MCAP'."
  count = sum(len(topic.messages) for topic in topics.values())
  reason = str(error).splitlines()[0] if str(error) else type(error).__name__
  return (
    f"{path.name} is truncated or damaged ({reason}): {count} messages are readable; copy it "
    "again, or read what is there with recover=True."
  )


def _check_time(name: str, topic: _Topic) -> None:
  for which, times in (("header stamps", topic.stamp_ns), ("log times", topic.log_ns)):
    steps = np.diff(np.array(times, dtype=np.int64))
    if np.any(steps < 0):
      at = int(np.argmax(steps < 0))
      raise LogError(
        f"{name}: time runs backwards on {topic.name} by {-steps[at] * _NANO:.6g} s at message "
        f"{at + 1} ({which}), {np.count_nonzero(steps < 0)} times in all; expected increasing "
        "stamps: record with one monotonic clock."
      )


def _seconds(times_ns: Sequence[int], start: int) -> np.ndarray:
  return (np.array(times_ns, dtype=np.int64) - start) * _NANO


def _joint_series(name: str, topic: _Topic, start: int) -> JointSeries:
  """Returns the arrays of a JointState topic, columns in the order of the first message."""
  joints = tuple(topic.messages[0].name)
  if not joints or len(set(joints)) < len(joints):
    raise LogError(f"{name}: {topic.name} names the joints {joints}, expected unique names.")
  orders: dict[tuple[str, ...], list[int]] = {}
  for index, message in enumerate(topic.messages):
    names = tuple(message.name)
    if names not in orders:
      if set(names) != set(joints):
        raise LogError(
          f"{name}: message {index} of {topic.name} names {list(names)}, the first one "
          f"{list(joints)}; expected the same joints in all: merge them before recording."
        )
      orders[names] = [names.index(joint) for joint in joints]
  fields: dict[str, np.ndarray | None] = {}
  for field in ("position", "velocity", "effort"):
    rows = [getattr(message, field) for message in topic.messages]
    lengths = {len(row) for row in rows}
    if lengths == {0}:
      fields[field] = None
      continue
    if lengths != {len(joints)}:
      raise LogError(
        f"{name}: {field}s of {topic.name} have lengths {sorted(lengths)}, expected "
        f"{len(joints)} in every message, one a joint."
      )
    values = np.array(rows, dtype=float)
    if len(orders) > 1:
      order = np.array([orders[tuple(message.name)] for message in topic.messages])
      values = np.take_along_axis(values, order, axis=1)
    # ros2_control fills interfaces that a servo lacks with NaN throughout: not measured.
    if field != "position" and np.all(np.isnan(values)):
      fields[field] = None
      continue
    _check_finite(name, f"{field}s of {topic.name}", values, topic, start)
    fields[field] = values
  return JointSeries(
    joints, _seconds(topic.stamp_ns, start), _seconds(topic.log_ns, start), **fields
  )


def _check_finite(name: str, what: str, values: np.ndarray, topic: _Topic, start: int) -> None:
  bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
  if bad.any():
    at = (topic.stamp_ns[int(np.argmax(bad))] - start) * _NANO
    raise LogError(
      f"{name}: NaN or infinite {what} in {np.count_nonzero(bad)} of {len(bad)} messages, first at "
      f"{at:.3f} s; expected finite numbers: cut those messages out or record again."
    )


def _imu(name: str, topic: _Topic, start: int) -> ImuSeries:
  rates = np.array(
    [(m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z) for m in topic.messages]
  )
  accelerations = np.array(
    [
      (m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z)
      for m in topic.messages
    ]
  )
  _check_finite(name, f"values of {topic.name}", np.hstack([rates, accelerations]), topic, start)
  return ImuSeries(
    _seconds(topic.stamp_ns, start),
    _seconds(topic.log_ns, start),
    rates,
    accelerations,
    topic.messages[0].header.frame_id,
  )


def _scalar(rows: Sequence[tuple[int, int, float]], start: int) -> ScalarSeries:
  stamps, logs, values = zip(*rows, strict=True)
  return ScalarSeries(_seconds(stamps, start), _seconds(logs, start), np.array(values, dtype=float))


def _battery(topic: _Topic, start: int) -> ScalarSeries | None:
  """Returns the voltage; by the message's definition NaN means not measured."""
  rows = [
    (stamp, log, message.voltage)
    for stamp, log, message in zip(topic.stamp_ns, topic.log_ns, topic.messages, strict=True)
    if np.isfinite(message.voltage)
  ]
  return _scalar(rows, start) if rows else None


def _temperatures(topics: Iterable[_Topic], start: int) -> dict[str, ScalarSeries]:
  """Returns the temperatures by joint, from whatever topics carry them."""
  rows: dict[str, list[tuple[int, int, float]]] = {}
  for topic in topics:
    if topic.schema != TEMPERATURE_TYPE:
      continue
    for stamp, log, message in zip(topic.stamp_ns, topic.log_ns, topic.messages, strict=True):
      if np.isfinite(message.temperature):
        rows.setdefault(message.header.frame_id, []).append((stamp, log, message.temperature))
  return {joint: _scalar(sorted(series), start) for joint, series in rows.items()}
