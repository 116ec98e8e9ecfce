"""Arrays of what a measured log holds.

N messages of a topic, J joints. Times are seconds from the first stamp in the file; `stamp` is the
message's header stamp, `log_time` the moment it was written down, on the same zero.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from nerf2real.core.robot_logs.messages import STATES, TEMPERATURE_TYPE
from nerf2real.core.robot_logs.streaming import NANO, LogError, Reading


@dataclasses.dataclass
class Topic:
  """The messages of one topic in the order of the file."""

  name: str
  schema: str
  stamp_ns: list[int] = dataclasses.field(default_factory=list)
  log_ns: list[int] = dataclasses.field(default_factory=list)
  messages: list[Any] = dataclasses.field(default_factory=list)

  def append(self, reading: Reading) -> None:
    """Adds a message."""
    self.stamp_ns.append(reading.stamp_ns)
    self.log_ns.append(reading.log_ns)
    self.messages.append(reading.message)


def check_time(name: str, topic: Topic) -> None:
  """Raises a LogError where the stamps or log times of a topic of file `name` decrease."""
  for which, times in (("header stamps", topic.stamp_ns), ("log times", topic.log_ns)):
    steps = np.diff(np.array(times, dtype=np.int64))
    if np.any(steps < 0):
      at = int(np.argmax(steps < 0))
      raise LogError(
        f"{name}: time runs backwards on {topic.name} by {-steps[at] * NANO:.6g} s at message "
        f"{at + 1} ({which}), {np.count_nonzero(steps < 0)} times in all; expected increasing "
        "stamps: record with one monotonic clock."
      )


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
  """[N, J] N m or N; of `/joint_pwm` the duty, -1 to 1. Of any field but the states' positions a
  column is NaN throughout where that joint has none."""

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


def _seconds(times_ns: Sequence[int], start: int) -> np.ndarray:
  return (np.array(times_ns, dtype=np.int64) - start) * NANO


def joint_series(name: str, topic: Topic, start: int) -> JointSeries:
  """Returns the arrays of a JointState topic, columns in the order of the first message.

  Args:
    name: of the file, for messages.
    topic: the messages.
    start: ns, zero of all times.

  Raises:
    LogError: joints differ between messages, a field has not one value a joint, or NaNs where a
      joint has other values, too.
  """
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
    # ros2_control fills interfaces that a joint lacks with NaN throughout: not measured.
    lacking = np.isnan(values).all(axis=0)
    if topic.name == STATES and field == "position" and lacking.any():
      unread = [joint for joint, none in zip(joints, lacking, strict=True) if none]
      raise LogError(
        f"{name}: positions of {unread} in {topic.name} are NaN throughout, expected numbers: "
        "record them, or leave those joints out of the topic."
      )
    if lacking.all():
      fields[field] = None
      continue
    _check_finite(name, f"{field}s of {topic.name}", values[:, ~lacking], topic, start)
    fields[field] = values
  return JointSeries(
    joints, _seconds(topic.stamp_ns, start), _seconds(topic.log_ns, start), **fields
  )


def _check_finite(name: str, what: str, values: np.ndarray, topic: Topic, start: int) -> None:
  bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
  if bad.any():
    at = (topic.stamp_ns[int(np.argmax(bad))] - start) * NANO
    raise LogError(
      f"{name}: NaN or infinite {what} in {np.count_nonzero(bad)} of {len(bad)} messages, first at "
      f"{at:.3f} s; expected finite numbers: cut those messages out or record again."
    )


def imu(name: str, topic: Topic, start: int) -> ImuSeries:
  """Returns the arrays of an Imu topic."""
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


def battery(topic: Topic, start: int) -> ScalarSeries | None:
  """Returns the voltage; by the message's definition NaN means not measured."""
  rows = [
    (stamp, log, message.voltage)
    for stamp, log, message in zip(topic.stamp_ns, topic.log_ns, topic.messages, strict=True)
    if np.isfinite(message.voltage)
  ]
  return _scalar(rows, start) if rows else None


def temperatures(topics: Iterable[Topic], start: int) -> dict[str, ScalarSeries]:
  """Returns the temperatures by joint, from whatever topics carry them."""
  rows: dict[str, list[tuple[int, int, float]]] = {}
  for topic in topics:
    if topic.schema != TEMPERATURE_TYPE:
      continue
    for stamp, log, message in zip(topic.stamp_ns, topic.log_ns, topic.messages, strict=True):
      if np.isfinite(message.temperature):
        rows.setdefault(message.header.frame_id, []).append((stamp, log, message.temperature))
  return {joint: _scalar(sorted(series), start) for joint, series in rows.items()}
