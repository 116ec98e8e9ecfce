"""Reads the JSON logs of BAM, Better Actuator Models (github.com/Rhoban/bam).

An object with `mass`, `length`, `kp`, `vin`, `motor`, `trajectory` and `entries`; each of these has
`timestamp` [s], `goal_position` [rad], `position` [rad], `speed` [rad/s], `load`,
`input_volts` [V], `temp` [degrees Celsius] and `torque_enable`; files as recorded, or resampled.
Source of the format: bam/dynamixel/record.py and bam/process.py there.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.core.robot_logs.series import JointSeries, ScalarSeries
from nerf2real.core.robot_logs.streaming import LogError
from nerf2real.sysid.data.checks import checked

FULL_DUTY = {"xl330": 885}
"""`load` at full duty by motor, where it is Present PWM (XL330-M288 e-manual, address 124); that of
other motors is a load without a unit, and is not read."""
UNNAMED = "(unnamed)"
"""The joint of a log: the format has one servo and no name for it."""
NEEDED = ("timestamp", "goal_position", "position")


def read_bam(path: Path) -> Log:
  """Reads a BAM log, whose joint is called `UNNAMED`.

  Raises:
    LogError: the file is no BAM log, an entry lacks a number, torque was off, or the log is too
      short or too slow.
  """
  try:
    content = json.loads(path.read_text())
  except (json.JSONDecodeError, UnicodeDecodeError) as error:
    raise LogError(f"{path.name} is not valid JSON: {error}.") from error
  entries = content.get("entries") if isinstance(content, dict) else None
  if not isinstance(entries, list) or not entries:
    found = sorted(content) if isinstance(content, dict) else type(content).__name__
    raise LogError(f"{path.name} has {found}, expected a BAM log with a list of entries.")
  table = {name: _numbers(path, entries, name) for name in NEEDED}
  off = [i for i, entry in enumerate(entries) if entry.get("torque_enable", True) is False]
  if off:
    at = table["timestamp"][off[0]] - table["timestamp"][0]
    raise LogError(
      f"{path.name}: torque is off in {len(off)} of {len(entries)} entries, first at {at:.3f} s; "
      "expected a servo that follows its commands: cut the log there."
    )
  start = float(table["timestamp"][0])
  stamps = table["timestamp"] - start

  def read(name: str) -> np.ndarray | None:
    return _numbers(path, entries, name) if name in entries[0] else None

  def series(position: Any = None, velocity: Any = None, effort: Any = None) -> JointSeries:
    columns = [None if v is None else v[:, None] for v in (position, velocity, effort)]
    return JointSeries((UNNAMED,), stamps, stamps, *columns)

  load, full = read("load"), FULL_DUTY.get(str(content.get("motor", "")).lower())
  volts, heat = read("input_volts"), read("temp")
  return checked(
    Log(
      name=path.name,
      start_ns=round(start * 1e9),
      commands=series(table["goal_position"]),
      states=series(table["position"], read("speed")),
      pwm=None if load is None or full is None else series(effort=load / full),
      imu=None,
      battery=None if volts is None else ScalarSeries(stamps, stamps, volts),
      temperatures={} if heat is None else {UNNAMED: ScalarSeries(stamps, stamps, heat)},
      path=path,
    )
  )


def _numbers(path: Path, entries: list[Any], name: str) -> np.ndarray:
  """Returns a field of all entries [N]."""
  values = [entry.get(name) if isinstance(entry, dict) else None for entry in entries]
  for index, value in enumerate(values):
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
      raise LogError(
        f"{path.name}: entry {index} has {value!r} as {name!r}, expected a finite number."
      )
  return np.array(values, float)
