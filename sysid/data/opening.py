"""Opens models, and measured logs of any format that is read: MCAP, CSV, BAM's JSON."""

import dataclasses
from collections.abc import Collection, Sequence
from pathlib import Path

import mujoco
import numpy as np

from nerf2real.core.robot_logs import reading
from nerf2real.core.robot_logs.reading import Log
from nerf2real.core.robot_logs.series import JointSeries, ScalarSeries
from nerf2real.core.robot_logs.streaming import LogError
from nerf2real.sysid.data.bam import UNNAMED, read_bam
from nerf2real.sysid.data.compatibility import check_against_model
from nerf2real.sysid.data.plausibility import check_plausible
from nerf2real.sysid.data.tables import read_csv
from nerf2real.sysid.model.drive import joint_of
from nerf2real.sysid.model.limits.supported import without_disabled


def read_log(path: str | Path) -> Log:
  """Reads a log by its file's ending: `.csv`, `.json` (BAM), else MCAP.

  Raises:
    FileNotFoundError: no such file.
    LogError: the log cannot be used.
  """
  path = Path(path)
  readers = {".csv": read_csv, ".json": read_bam}
  reader = readers.get(path.suffix.lower(), reading.read_log)
  if not path.is_file():
    raise FileNotFoundError(f"Found no file {path}, expected a measured log (.mcap, .csv, .json).")
  return reader(path)


def named(log: Log, model: mujoco.MjModel) -> Log:
  """Returns a log whose joint without a name (BAM's) has that of the model's driven joint.

  Raises:
    LogError: the model does not drive one joint alone.
  """
  if log.joints != (UNNAMED,):
    return log
  driven = sorted({joint for u in range(model.nu) if (joint := joint_of(model, u)) is not None})
  if len(driven) != 1:
    raise LogError(
      f"{log.name} has one joint without a name, the model drives {driven}: give a model of that "
      "one servo."
    )

  def renamed(series: JointSeries | None) -> JointSeries | None:
    return series and dataclasses.replace(series, joints=(driven[0],))

  commands, states = renamed(log.commands), renamed(log.states)
  assert commands is not None and states is not None
  heat = dict(zip(driven, log.temperatures.values(), strict=False))  # of one servo, or none
  return dataclasses.replace(
    log, commands=commands, states=states, pwm=renamed(log.pwm), temperatures=heat
  )


def load_model(path: Path) -> mujoco.MjModel:
  """Reads a MuJoCo model; a file that is missing or wrong is one clear error."""
  if not Path(path).is_file():
    raise FileNotFoundError(f"Found no file {path}, expected a MuJoCo model (.xml).")
  try:
    return without_disabled(mujoco.MjModel.from_xml_path(str(path)))
  except ValueError as error:
    first = str(error).strip().splitlines()[0]
    raise ValueError(f"{path} is not a MuJoCo model: {first}") from error


def without_fillers(log: Log) -> Log:
  """Returns a log without what drivers fill in for what they do not measure: efforts that never
  change or are NaN, and voltages that are not above 0."""
  states, battery = log.states, log.battery
  if states.effort is not None and not (np.ptp(states.effort, axis=0) > 0.0).any():
    states = dataclasses.replace(states, effort=None)
  if battery is not None and not np.all(battery.value > 0.0):
    read = battery.value > 0.0
    columns = (battery.stamp[read], battery.log_time[read], battery.value[read])
    battery = ScalarSeries(*columns) if read.any() else None
  return dataclasses.replace(log, states=states, battery=battery)


def from_first_command(log: Log) -> Log:
  """Returns a log whose states begin with its commands: what came before was told what no log says.

  A single reading before the first command is of the same cycle, and stays.
  """
  states = log.states
  first = int(np.searchsorted(states.stamp, log.commands.stamp[0]))
  if first < 2:
    return log
  fields = (states.position, states.velocity, states.effort)
  begun = JointSeries(
    *(states.joints, states.stamp[first:], states.log_time[first:]),
    *(None if values is None else values[first:] for values in fields),
  )
  return dataclasses.replace(log, states=begun, recorded=states)


def set_aside(log: Log, joints: Collection[str]) -> Log:
  """Returns a log of which joints are not judged: their commands are in `aside`."""
  names = log.commands.joints
  apart = [n for n, name in enumerate(names) if name in joints]
  if not apart:
    return log
  kept = [n for n in range(len(names)) if n not in apart]
  return dataclasses.replace(
    log, commands=_columns(log.commands, kept), aside=_columns(log.commands, apart)
  )


def _columns(series: JointSeries, kept: Sequence[int]) -> JointSeries:
  fields = (series.position, series.velocity, series.effort)
  return JointSeries(
    *(tuple(series.joints[n] for n in kept), series.stamp, series.log_time),
    *(None if values is None else values[:, kept] for values in fields),
  )


def read_logs(paths: Sequence[Path], model: mujoco.MjModel) -> list[Log]:
  """Reads logs, whose states begin with their commands, and checks them against the model."""
  logs = []
  for path in paths:
    log = from_first_command(without_fillers(named(read_log(path), model)))
    check_against_model(log, model)
    logs.append(log)
  check_plausible(logs, model)
  return logs
