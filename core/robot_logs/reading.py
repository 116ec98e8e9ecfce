"""Measured logs: MCAP files with ROS 2 messages, read into arrays and checked.

`topics` reads the file, `series` makes the arrays; what a log must be to be usable is here.
"""

import dataclasses
import pathlib
from collections.abc import Sequence

import mujoco
import numpy as np

from nerf2real.core.robot_logs.series import (
  ImuSeries,
  JointSeries,
  ScalarSeries,
  battery,
  imu,
  joint_series,
  temperatures,
)
from nerf2real.core.robot_logs.topics import (
  BATTERY,
  COMMANDS,
  IMU,
  PWM,
  STATES,
  LogError,
  check_time,
  read_topics,
)

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
  "check_against_model",
  "read_log",
]

MINIMUM_DURATION = 1.0
"""s; ours: a shorter log holds not one period of the slowest excitation of a servo joint."""


MINIMUM_RATE = 20.0
"""Hz; ours: servo joints answer within a tenth of a second, which two readings must show."""

MINIMUM_MOTION = 1e-4
"""rad or m; ours: less is rounding."""


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
  topics, damaged = read_topics(path, recover)
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
    pwm=joint_series(path.name, topics[PWM], start) if PWM in topics else None,
    imu=imu(path.name, topics[IMU], start) if IMU in topics else None,
    battery=battery(topics[BATTERY], start) if BATTERY in topics else None,
    temperatures=temperatures(topics.values(), start),
    recovered=damaged,
    path=path,
  )
  if log.duration < MINIMUM_DURATION:
    raise LogError(
      f"{path.name} lasts {max(log.duration, 0.0):.3g} s with commands and states, expected at "
      f"least {MINIMUM_DURATION:g} s: record a longer log."
    )
  span = states.stamp[-1] - states.stamp[0]
  if len(states.stamp) < MINIMUM_RATE * span:
    raise LogError(
      f"{path.name} has {len(states.stamp)} readings of {STATES} in {span:.3g} s, expected at "
      f"least {MINIMUM_RATE:g} a second: record faster."
    )
  return log


def check_motion(logs: Sequence[Log]) -> None:
  """Raises a LogError where no joint that is commanded moves in any of the logs."""
  for log in logs:
    assert log.states.position is not None
    columns = [log.states.column(joint) for joint in log.commands.joints]
    if np.ptp(log.states.position[:, columns], axis=0).max() > MINIMUM_MOTION:
      return
  names = ", ".join(log.name for log in logs)
  raise LogError(
    f"Found no commanded joint that moves in {names}, expected some motion: record a sweep, a slow "
    "motion and steps."
  )


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
