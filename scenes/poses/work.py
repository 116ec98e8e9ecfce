"""What the ways of localising share: their steps, their folder of work, their result."""

import dataclasses
import hashlib
import json
import shutil
import time
from collections.abc import Mapping
from pathlib import Path

from nerf2real.core.progress import Progress, part
from nerf2real.core.serialization import to_plain
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.film.shutter import Shutter
from nerf2real.scenes.poses.settings import LocaliseSettings

_DATABASE = "database.db"
SHARES = {
  "features": 0.25,
  "matching": 0.4,
  "mapping": 0.17,
  "holding": 0.03,
  "refining": 0.05,
  "aligning": 0.04,
  "shutter": 0.03,
  "settling": 0.03,
}
# Where poses came with the pictures few pairs are matched, and all are triangulated and adjusted
# twice.
KNOWN_SHARES = {"features": 0.3, "matching": 0.2, "refining": 0.5}


@dataclasses.dataclass(frozen=True)
class Mapped:
  """A model of the keyframes and how it was made."""

  model: pycolmap.Reconstruction
  """In the source's frame."""
  strategy: str
  warnings: tuple[str, ...]
  lens: mapping.FreeLens | None = None
  """What was estimated of the lens; None where it was known."""
  left_out: tuple[str, ...] = ()
  """Pictures out of a film's line, see `film/continuity.py`, or whose place hung on little, see
  `checks/certainty.py`."""
  shutter: Shutter | None = None


class Steps:
  """Times the steps and turns their progress into one fraction."""

  def __init__(self, progress: Progress, shares: Mapping[str, float] = SHARES):
    self._progress, self._shares = progress, shares
    self._name, self._start = "", time.perf_counter()
    self.seconds: dict[str, float] = {}

  def begin(self, name: str) -> None:
    self.end()
    self._name, self._start = name, time.perf_counter()

  def end(self) -> None:
    if self._name:
      spent = time.perf_counter() - self._start
      self.seconds[self._name] = self.seconds.get(self._name, 0.0) + spent
    self._name = ""

  def report(self, fraction: float, text: str) -> None:
    done = 0.0
    for name, share in self._shares.items():
      if name == self._name:
        part(self._progress, done, done + share)(fraction, text)
        return
      done += share


def prepare_work(
  images_folder: Path,
  work: Path,
  names: list[str],
  settings: LocaliseSettings,
  known: KnownPoses | None,
) -> Path:
  """Returns the database, after removing one that was made of other pictures or settings."""
  digest = hashlib.sha256()
  described = to_plain(settings.features)
  described["camera"] = None if known is None else to_plain(known.camera)
  described["seed"] = settings.seed
  digest.update(json.dumps(described, sort_keys=True).encode())
  for name in names:
    digest.update(name.encode())
    digest.update(hashlib.sha256((images_folder / name).read_bytes()).digest())
  stamp = work / "inputs.sha256"
  if not stamp.is_file() or stamp.read_text() != digest.hexdigest():
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    stamp.write_text(digest.hexdigest())
  return work / _DATABASE
