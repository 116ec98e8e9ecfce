"""Opens measured logs of any format that is read: MCAP, CSV, BAM's JSON."""

from pathlib import Path

import mujoco

from nerf2real.core.robot_logs.reading import Log, read_log
from nerf2real.sysid.data.bam import read_bam
from nerf2real.sysid.data.tables import read_csv


def open_log(path: Path, model: mujoco.MjModel) -> Log:
  """Reads a log by its file's ending; `.csv` and `.json` beside MCAP.

  Raises:
    FileNotFoundError: no such file.
    LogError: the log cannot be used.
  """
  path = Path(path)
  ending = path.suffix.lower()
  if ending not in (".csv", ".json"):
    return read_log(path)
  if not path.is_file():
    raise FileNotFoundError(f"Found no file {path}, expected a measured log.")
  if ending == ".csv":
    return read_csv(path)
  driven = model.actuator_trnid[0, 0] if model.nu else 0  # the format has one joint, unnamed
  return read_bam(path, joint=model.joint(int(driven)).name)
