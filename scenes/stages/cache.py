"""Caches the stages of a long job by the hash of their inputs; resumes interrupted ones.

A stage writes into a work folder that carries its key. When it ends, the folder is renamed to its
final name, so that a folder with that name is always whole. A second run with the same inputs and
settings finds it and does nothing; one with others starts that stage and all that follow anew.
"""

import contextlib
import dataclasses
import hashlib
import json
import shutil
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from nerf2real.core import files
from nerf2real.core.progress import Progress, progress_bar
from nerf2real.core.serialization import to_plain

T = TypeVar("T")

_RECORD = "stage.json"
_KEY_LENGTH = 16  # hexadecimal digits of the key in a folder's name


class StageError(ValueError):
  """A stage could not be run; the message is one line for the user."""


@dataclasses.dataclass(frozen=True)
class StageResult:
  """A finished stage."""

  folder: Path
  """What the stage wrote."""
  key: str
  """Hash of its name, settings and inputs."""
  made: str
  """Drawn when it was made: two runs of equal settings may differ, as training does."""
  seconds: float
  """How long it took, summed over interrupted runs."""
  cached: bool
  """True where an earlier run had done it."""


class Made(NamedTuple, Generic[T]):
  """A stage's result and the folder that it was read from."""

  value: T
  stage: StageResult

  @property
  def stamp(self) -> str:
    """Hash of this result as the input of other stages."""
    return self.stage.made


class Stages:
  """Runs the stages of one job in a folder, with a progress bar for each."""

  def __init__(self, folder: Path, *, show_progress: bool = True):
    self.folder = Path(folder)  # made by the first stage
    self.results: dict[str, StageResult] = {}
    self._show_progress = show_progress

  def run(
    self,
    name: str,
    function: Callable[[Path, Progress], None],
    *,
    settings: Any,
    inputs: Mapping[str, str],
    version: int = 1,
  ) -> StageResult:
    """Runs a stage unless its result is there.

    Args:
      name: Name of the stage and of its folder.
      function: Writes the result into the folder given; may find what an interrupted run of the
        same key left there, and may continue from it.
      settings: Whatever the result depends on; a dataclass or plain values.
      inputs: Hashes of the files, and `made` of the stages, that the result depends on.
      version: Raised when the stage's code changes what it writes.

    Returns:
      The finished stage.

    Raises:
      StageError: The disk is full.
    """
    description = {
      "name": name,
      "version": version,
      "settings": to_plain(settings),
      "inputs": dict(inputs),
    }
    key = hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()
    final = self.folder / name
    record = _read_record(final)
    if record.get("key") == key:
      made = str(record.get("made", key))
      result = StageResult(final, key, made, float(record["seconds"]), cached=True)
      self.results[name] = result
      with progress_bar(name, shown=self._show_progress) as report:
        report(1.0, "done before")
      return result

    work = self.folder / f"{name}.{key[:_KEY_LENGTH]}.partial"
    for stale in self.folder.glob(f"{name}.*.partial"):
      if stale != work:
        shutil.rmtree(stale, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    earlier = float(_read_record(work).get("seconds", 0.0))
    start = time.monotonic()
    try:
      with progress_bar(name, shown=self._show_progress) as report:
        function(work, report)
        report(1.0, "done")
    except OSError as error:
      if files.is_disk_full(error):
        raise StageError(
          f"The disk that holds {self.folder} is full (stage {name}): free some space and run the "
          "same command again, it continues here."
        ) from error
      raise
    finally:
      seconds = earlier + time.monotonic() - start
      with contextlib.suppress(OSError):  # a full disk must not hide the error that is under way
        if _is_empty(work):  # nothing that another run could continue from
          shutil.rmtree(work)
          self.folder.rmdir()
        else:
          self._write_record(work, {"seconds": seconds})
    made = uuid.uuid4().hex
    work.mkdir(parents=True, exist_ok=True)
    self._write_record(work, {"key": key, "made": made, "seconds": seconds, **description})
    files.replace_folder(work, final)
    result = StageResult(final, key, made, seconds, cached=False)
    self.results[name] = result
    return result

  @staticmethod
  def _write_record(folder: Path, record: Mapping[str, Any]) -> None:
    files.write_atomically(folder / _RECORD, json.dumps(record, indent=1, sort_keys=True))


def key_of(folder: Path) -> str | None:
  """Returns the key of the finished stage that a folder holds; None where it holds none."""
  return _read_record(folder).get("key")


def _read_record(folder: Path) -> dict[str, Any]:
  try:
    return json.loads((folder / _RECORD).read_text())
  except (OSError, json.JSONDecodeError):
    return {}


def _is_empty(folder: Path) -> bool:
  """Returns whether a stage's folder holds nothing but its record."""
  return all(path.name == _RECORD for path in folder.iterdir())
