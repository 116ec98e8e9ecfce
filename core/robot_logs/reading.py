"""Measured logs: MCAP files with ROS 2 messages, read into arrays and checked.

`streaming` reads the file, `series` makes the arrays; what a log must be to be usable is here.
"""

import dataclasses
import pathlib
from collections.abc import Sequence

import numpy as np

from nerf2real.core.robot_logs.messages import (
  BATTERY,
  COMMANDS,
  IMAGE,
  IMU,
  PWM,
  STATES,
  TEMPERATURE_TYPE,
)
from nerf2real.core.robot_logs.series import (
  ImuSeries,
  JointSeries,
  ScalarSeries,
  Topic,
  battery,
  check_time,
  imu,
  joint_series,
  temperatures,
)
from nerf2real.core.robot_logs.streaming import DamagedLogError, LogError, read_messages

__all__ = [
  "BATTERY",
  "COMMANDS",
  "IMU",
  "PWM",
  "STATES",
  "ImuSeries",
  "JointSeries",
  "Log",
  "LogError",
  "ScalarSeries",
  "read_log",
]

_TOPICS = (COMMANDS, STATES, PWM, IMU, BATTERY, IMAGE)
MINIMUM_DURATION = 1.0
"""s; chosen: a shorter log holds not one period of the slowest excitation of a servo joint."""


MINIMUM_RATE = 20.0
"""Hz; chosen: servo joints answer within a tenth of a second, which two readings must show."""

MINIMUM_MOTION = 1e-4
"""rad or m; chosen: less is rounding."""


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
  path: pathlib.Path | None = None
  """The file, which holds the pictures too; None of a log that was never written."""
  pictures: int = 0
  """How many pictures the file holds."""
  recorded: JointSeries | None = None
  """All states, where `states` leave out those before the first command; None where none are."""
  aside: JointSeries | None = None
  """Commands of joints that are not judged, which move all the same; None where all are in
  `commands`."""

  @property
  def whole(self) -> "Log":
    """The log with the states before its first command, too."""
    if self.recorded is None:
      return self
    return dataclasses.replace(self, states=self.recorded, recorded=None)

  @property
  def joints(self) -> tuple[str, ...]:
    """The joints whose states were measured."""
    return self.states.joints

  @property
  def duration(self) -> float:
    """Seconds that commands and states cover together."""
    first = max(self.commands.stamp[0], self.states.stamp[0])
    return float(min(self.commands.stamp[-1], self.states.stamp[-1]) - first)


def read_log(path: str | pathlib.Path, *, recover: bool = False) -> Log:
  """Reads a measured log.

  Args:
    path: an MCAP file with at least `/joint_commands` and `/joint_states`.
    recover: read what is readable of a damaged file instead of raising; whole chunks only.

  Raises:
    FileNotFoundError: no such file.
    LogError: not an MCAP, damaged, without commands or states, with NaNs, with time running
      backwards, shorter than `MINIMUM_DURATION` or slower than `MINIMUM_RATE`.
  """
  path = pathlib.Path(path)
  if not path.is_file():
    raise FileNotFoundError(f"Found no file {path}, expected a measured log (.mcap).")
  topics: dict[str, Topic] = {}
  pictures, damaged = 0, False
  try:
    # Temperatures are found by type: the topic's name is free, frame_id names the joint.
    for reading in read_messages(path, topics=_TOPICS, schemas=[TEMPERATURE_TYPE]):
      if reading.topic == IMAGE:  # read again when they are looked at: too many to keep
        pictures += 1
        continue
      if reading.topic not in topics:
        topics[reading.topic] = Topic(reading.topic, reading.schema)
      topics[reading.topic].append(reading)
  except DamagedLogError:
    if not recover:
      raise
    damaged = True
  for topic in topics.values():
    check_time(path.name, topic)
  for name, holds in ((COMMANDS, "commands"), (STATES, "states")):
    if name not in topics:
      raise LogError(
        f"{path.name} has no {holds}: expected messages on {name}, found the topics "
        f"{sorted(topics) or 'none'}; record that topic too."
      )
  start = min(min(topic.stamp_ns) for topic in topics.values())
  commands = joint_series(path.name, topics[COMMANDS], start)
  states = joint_series(path.name, topics[STATES], start)
  if all(field is None for field in (commands.position, commands.velocity, commands.effort)):
    raise LogError(
      f"{path.name} has no commands: {COMMANDS} holds no positions, velocities or efforts in its "
      f"{len(commands.stamp)} messages; record what the actuators are told."
    )
  if states.position is None:
    raise LogError(f"{path.name} has no positions in {STATES}: record the joints' positions.")
  log = Log(
    name=path.name,
    start_ns=start,
    commands=commands,
    states=states,
    pwm=joint_series(path.name, topics[PWM], start) if PWM in topics else None,
    imu=imu(path.name, topics[IMU], start) if IMU in topics else None,
    battery=battery(topics[BATTERY], start) if BATTERY in topics else None,
    temperatures=temperatures(topics.values(), start),
    recovered=damaged,
    path=path,
    pictures=pictures,
  )
  check_extent(log)
  return log


def check_extent(log: Log) -> None:
  """Raises a LogError where commands and states do not overlap for `MINIMUM_DURATION`, or states
  are slower than `MINIMUM_RATE`."""
  commands, states = log.commands.stamp, log.states.stamp
  if log.duration < 0.0:
    spans = [f"{stamp[0]:.3f} to {stamp[-1]:.3f} s" for stamp in (commands, states)]
    raise LogError(
      f"{log.name}: commands and states do not overlap: found commands at {spans[0]} and states at "
      f"{spans[1]}, expected stamps of one clock: record both at once, by the same clock."
    )
  if log.duration < MINIMUM_DURATION:
    raise LogError(
      f"{log.name} lasts {log.duration:.3g} s with commands and states, expected at "
      f"least {MINIMUM_DURATION:g} s: record a longer log."
    )
  span = states[-1] - states[0]
  if len(states) < MINIMUM_RATE * span:
    raise LogError(
      f"{log.name} has {len(states)} readings of the states in {span:.3g} s, expected at "
      f"least {MINIMUM_RATE:g} a second: record faster."
    )


def check_motion(logs: Sequence[Log]) -> None:
  """Raises a LogError where no joint that is commanded moves in any of the logs."""
  if any(moves([log], joint) for log in logs for joint in log.commands.joints):
    return
  names = ", ".join(log.name for log in logs)
  raise LogError(
    f"Found no commanded joint that moves in {names}, expected some motion: record a sweep, a slow "
    "motion and steps."
  )


def moves(logs: Sequence[Log], joint: str) -> bool:
  """Tells whether a joint moves in any of some logs that measure it."""
  for log in logs:
    assert log.states.position is not None
    if np.ptp(log.states.position[:, log.states.column(joint)]) > MINIMUM_MOTION:
      return True
  return False
