"""The starts of trials in the logs that they left, and the floor's slope from them.

Before every trial the robot is let go on its feet and stands still for a while without a command,
at the heading of the protocol; then commands come at 40 Hz until the episode ends. The silences of
the log are therefore the stops, and which trial follows is known by how long its commands last. A
robot that is turned on purpose (`recording.record_floor`) shows the same from fewer stops, in axes
of its first heading; here they are the room's.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.core.robot_logs.reading import Log, read_log
from nerf2real.evaluation.episodes import Episode
from nerf2real.evaluation.loop.robot.motions import standing_model
from nerf2real.evaluation.plants import plant as plants
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.suite.op3.constants import CONTROL_TIMESTEP
from nerf2real.suite.protocols import NavigationTrial
from nerf2real.sysid.sensors import floor
from nerf2real.sysid.sensors.sensed import Part
from nerf2real.sysid.sensors.stops import Stood
from nerf2real.sysid.sensors.walks.replay import Walk

_SETTINGS = RobotSettings()
_SAME = 2 * CONTROL_TIMESTEP  # s by which an episode and its commands may differ in length


class Walked(NamedTuple):
  """The trials of a condition on a robot."""

  logs: tuple[Path, ...]  # in the order of recording
  episodes: tuple[Episode, ...]  # likewise; of a protocol of navigation


def logs(folder: Path, stem: str) -> tuple[Path, ...]:
  """Returns the logs stem.mcap, stem_2.mcap, ... of a condition, as `making.free_name` counts."""
  found = [(path, re.fullmatch(rf"{stem}(?:_(\d+))?", path.stem)) for path in folder.glob("*.mcap")]
  numbered = [(int(match[1] or 1), path) for path, match in found if match]
  return tuple(path for _, path in sorted(numbered))


def read(walked: Walked) -> list[list[Walk]]:
  """Returns what was walked in the trials, log by log.

  Raises:
    LogError: A log cannot be read.
  """
  return walks([read_log(path, recover=True) for path in walked.logs], walked.episodes)


def find(walked: Sequence[Sequence[Walk]]) -> Part | None:
  """Returns the floor's slope in the axes of the room; None where no trial begins in the logs."""
  listed = [walks for walks in walked if walks]
  if not listed:
    return None
  stood = [[Stood(walk.begin, walk.first, walk.heading) for walk in walks] for walks in listed]
  found = floor.find(standing_model(), [walks[0].log for walks in listed], stood)
  if found is not None and found.estimates:
    count = sum(len(stops) for stops in stood)
    found.notes.append(f"The floor's slope is from {count} starts of trials, in the room's axes.")
  return found


def walks(logs: Sequence[Log], episodes: Sequence[Episode]) -> list[list[Walk]]:
  """Returns where the robot stood before each trial and how long it walked then, log by log.

  A trial that was cut short left commands and no episode: it is left out.
  """
  trials = plants.trials(episodes[0].setting.protocol) if episodes else ()
  left, found = list(episodes), []
  for log in logs:
    walked = []
    for begin, first, last in _runs(log.commands.stamp):
      lasted = last - first + CONTROL_TIMESTEP
      match = next((i for i, e in enumerate(left) if abs(e.duration - lasted) < _SAME), None)
      if match is None:
        continue
      trial = trials[left[match].index][1]
      left = left[match + 1 :]
      if isinstance(trial, NavigationTrial):
        walked.append(Walk(log, begin, first, last, trial.yaw))
    found.append(walked)
  return found


def _runs(stamp: np.ndarray) -> list[tuple[float, float, float]]:
  """Returns of every run of commands after a stand: where it rests before, first and last command.

  Args:
    stamp: of the commands [T] [s].
  """
  gaps = np.diff(stamp)
  ends = np.append(np.flatnonzero(gaps > _SETTINGS.grip_time / 2), len(stamp) - 1)
  stands = np.flatnonzero(gaps > 0.9 * _SETTINGS.settle_time)
  found = []
  for stand in stands:
    first, last = stamp[stand + 1], stamp[ends[ends > stand][0]]
    found.append((float(first - _SETTINGS.rest_time), float(first), float(last)))
  return found
