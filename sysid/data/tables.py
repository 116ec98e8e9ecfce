"""Reads measured logs from CSV files with a header.

One row a reading. Columns are `time` [s] and, with a joint's name after the colon, any of
`command_position:J`, `command_velocity:J`, `command_effort:J`, `position:J`, `velocity:J`,
`effort:J`, `duty:J` and `temperature:J` (SI, degrees Celsius), and `voltage`; another unit follows
the name in brackets, as in `position:elbow [deg]` or `time [ms]`. An empty field is a
value that was not read at that time, so commands and states may have rows of their own; a column
without values is as none. Joints may be commanded by different quantities, as wheels by velocity
beside an arm by position. `velocity:J` is not looked at: velocities are those of the positions.
"""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerf2real.core.robot_logs.reading import MINIMUM_RATE, Log
from nerf2real.core.robot_logs.series import JointSeries, ScalarSeries
from nerf2real.core.robot_logs.streaming import LogError
from nerf2real.sysid.data.checks import checked

COMMANDED = ("command_position", "command_velocity", "command_effort")
OF_JOINTS = (
  *COMMANDED,
  *("position", "velocity", "effort", "duty", "temperature"),
)
ALONE = ("time", "voltage")
UNITS = {
  **dict.fromkeys(("s", "rad", "rad/s", "m", "m/s", "N", "N m", "Nm", "V", "1", "degC"), 1.0),
  **{"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "mm": 1e-3, "mm/s": 1e-3, "mN m": 1e-3, "mV": 1e-3},
  **{"deg": math.pi / 180, "deg/s": math.pi / 180, "%": 0.01},
}
"""What a number in a unit is in SI."""
_SEPARATORS = (";", "\t", "|")
_SELDOM = 1.0
"""s between readings from which on their time is taken for one in another unit: chosen, twenty
times the longest that is read."""


def read_csv(path: Path) -> Log:
  """Reads a CSV log.

  Raises:
    LogError: columns are unknown or missing, a field is no finite number, time runs backwards,
      joints have readings at different times, or the log is too short or too slow.
  """
  columns = _columns(path)
  time = columns.pop("time")
  if np.isnan(time).any():
    raise LogError(f"{path.name} has rows without a time, expected seconds in every row.")
  columns = {name: values for name, values in columns.items() if not np.isnan(values).all()}
  start = float(time[0])
  quantities: dict[str, dict[str, np.ndarray]] = {}
  for name, values in columns.items():
    quantity, _, joint = name.partition(":")
    quantities.setdefault(quantity, {})[joint] = values
  stamps = time - start
  commands = _series(path, stamps, quantities, COMMANDED, mixed=True)
  states = _series(path, stamps, quantities, ("position", None, "effort"))
  if commands is None or states is None or states.position is None:
    lacks = (
      " or ".join(f"{name}:JOINT" for name in COMMANDED) if commands is None else "position:JOINT"
    )
    raise LogError(f"{path.name} has no column {lacks} with values, found {sorted(columns)}.")
  _check_unit_of_time(path, states.stamp)
  voltage = _scalar(stamps, columns.get("voltage"))
  heat = {j: _scalar(stamps, v) for j, v in quantities.get("temperature", {}).items()}
  return checked(
    Log(
      name=path.name,
      start_ns=round(start * 1e9),
      commands=commands,
      states=states,
      pwm=_series(path, stamps, quantities, (None, None, "duty")),
      imu=None,
      battery=voltage,
      temperatures={joint: series for joint, series in heat.items() if series is not None},
      path=path,
    )
  )


def _columns(path: Path) -> dict[str, np.ndarray]:
  """Returns the columns by name, NaN where a field is empty."""
  try:
    with path.open(newline="", encoding="utf-8-sig") as stream:
      rows = [row for row in csv.reader(stream) if row]
  except (UnicodeDecodeError, csv.Error) as error:
    raise LogError(f"{path.name} is no CSV text: {error}.") from error
  if len(rows) < 2:
    raise LogError(f"{path.name} has {len(rows)} lines, expected a header and readings.")
  _check_header(path, rows[0])
  names, factors = zip(*(_named(path, name.strip()) for name in rows[0]), strict=True)
  for name in names:
    quantity, _, joint = name.partition(":")
    if name not in ALONE and not (quantity in OF_JOINTS and joint):
      raise LogError(
        f"{path.name} has the column {name!r}, expected {', '.join(ALONE)} or one of "
        f"{', '.join(OF_JOINTS)} followed by :JOINT."
      )
  if "time" not in names or len(set(names)) < len(names):
    raise LogError(
      f"{path.name} has the columns {list(names)}, expected each once and `time` among them."
    )
  table = np.full((len(rows) - 1, len(names)), math.nan)
  for index, row in enumerate(rows[1:]):
    if len(row) != len(names):
      raise LogError(
        f"{path.name} line {index + 2} has {len(row)} fields, the header {len(names)}."
      )
    for place, field in enumerate(row):
      if not field.strip():
        continue
      try:
        table[index, place] = float(field)
      except ValueError:
        table[index, place] = math.nan
      if not math.isfinite(table[index, place]):
        raise LogError(
          f"{path.name} line {index + 2} has {field!r} as {names[place]}, expected a number, or "
          "nothing where none was read."
        )
  return dict(zip(names, (table * factors).T, strict=True))


def _check_header(path: Path, fields: Sequence[str]) -> None:
  """Raises a LogError where the first line is not one of names between commas."""
  if len(fields) == 1 and (found := [sign for sign in _SEPARATORS if sign in fields[0]]):
    raise LogError(
      f"{path.name} has {found[0]!r} between its columns, expected ',' and decimal points: write "
      "it with those."
    )
  try:
    numbers = [float(field) for field in fields if field.strip()]
  except ValueError:
    return
  raise LogError(
    f"{path.name} begins with the numbers {numbers[:3]}, expected names in the first line: put the "
    "header there, such as time,command_position:JOINT,position:JOINT."
  )


def _check_unit_of_time(path: Path, stamps: np.ndarray) -> None:
  """Raises a LogError where readings come so seldom that their time [N] is not in seconds."""
  steps = np.diff(stamps)
  step = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0
  if step < _SELDOM:
    return
  unit = next((unit for unit in ("ms", "us", "ns") if step * UNITS[unit] < 1.0 / MINIMUM_RATE), "")
  if unit:
    raise LogError(
      f"{path.name} has a reading every {step:.3g} s, expected at least {MINIMUM_RATE:g} a second: "
      f"name the unit in the header if it is not s, such as `time [{unit}]`."
    )


def _named(path: Path, column: str) -> tuple[str, float]:
  """Returns a column's name without its unit, and what a number in that unit is in SI."""
  name, bracket, unit = column.removesuffix("]").partition("[")
  if not bracket:
    return column, 1.0
  if unit.strip() not in UNITS:
    raise LogError(
      f"{path.name} has the column {column!r} in the unit {unit.strip()!r}, expected one of "
      f"{', '.join(UNITS)}: convert its numbers, or leave the brackets out where they are SI."
    )
  return name.strip(), UNITS[unit.strip()]


def _series(
  path: Path,
  stamps: np.ndarray,
  quantities: dict[str, dict[str, np.ndarray]],
  fields: Sequence[str | None],
  *,
  mixed: bool = False,
) -> JointSeries | None:
  """Returns the rows in which quantities were read, as position, velocity and effort.

  Args:
    path: for messages.
    stamps: of all rows [N], s.
    quantities: columns [N] by joint, by quantity.
    fields: the quantities that are position, velocity and effort there.
    mixed: whether joints may have different ones: NaN stands where a joint has none.
  """
  present = [name for name in fields if name is not None and name in quantities]
  if not present:
    return None
  joints = tuple(dict.fromkeys(joint for name in present for joint in quantities[name]))
  for name in present:
    if not mixed and set(quantities[name]) != set(joints):
      others = next(n for n in present if set(quantities[n]) != set(quantities[name]))
      raise LogError(
        f"{path.name} has {name} of {sorted(quantities[name])} and {others} of "
        f"{sorted(quantities[others])}, expected the same joints."
      )
  none = np.full(len(stamps), math.nan)
  arrays = {
    name: np.stack([quantities[name].get(joint, none) for joint in joints], axis=1)
    for name in present
  }
  read = ~np.isnan(np.stack([c for name in present for c in quantities[name].values()], axis=1))
  rows = read.any(axis=1)
  if not read[rows].all():
    line = int(np.flatnonzero(rows & ~read.all(axis=1))[0]) + 2
    raise LogError(
      f"{path.name} line {line} has some of {', '.join(present)} and not all, expected all joints' "
      "in a row, or none."
    )
  columns = [None if name is None or name not in arrays else arrays[name][rows] for name in fields]
  return JointSeries(joints, stamps[rows], stamps[rows], *columns)


def _scalar(stamps: np.ndarray, values: np.ndarray | None) -> ScalarSeries | None:
  if values is None or np.isnan(values).all():
    return None
  read = ~np.isnan(values)
  return ScalarSeries(stamps[read], stamps[read], values[read])
