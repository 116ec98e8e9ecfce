"""One writer a folder: an advisory lock with its owner's process and host; whose a folder is.

The lock is `flock` on a file in the folder, so that the kernel releases it however its owner ends:
a lock file without a living owner is stale and is taken over. Where the file system knows no
`flock`, the owner's process id decides on the same host, and a lock of another host counts.
"""

import contextlib
import errno
import fcntl
import json
import os
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nerf2real.core import files

FILE = ".lock"
_TAKEN = (errno.EWOULDBLOCK, errno.EACCES)
_UNSUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
_POLL = 0.2  # s between attempts
_ATTEMPTS = 5  # a lock's file may be removed by its owner between opening and locking


class FolderInUseError(OSError):
  """Another process writes the folder; the message is one line that names it."""


@contextlib.contextmanager
def lock_folder(folder: str | Path, *, name: str = FILE, patience: float = 0.0) -> Iterator[None]:
  """Holds the lock of an output folder while the block runs.

  The folder is created. Folders that were created here and are empty at the end are removed again,
  so that a command that refuses its arguments leaves nothing.

  Args:
    folder: The folder.
    name: Of the lock's file; parts of a folder that different processes write have names of their
      own.
    patience: Time to wait for a lock that another process holds [s].

  Raises:
    FolderInUseError: Another process, or another thread of this one, holds the lock.
    OSError: The folder cannot be created or written.
  """
  folder = Path(folder)
  created = _create(folder)
  path = folder / name
  try:
    with files.explain_disk_full(path):
      descriptor = _take_patiently(path, patience)
    try:
      yield
    finally:
      with contextlib.suppress(OSError):  # must not hide the error that is under way
        path.unlink()
      os.close(descriptor)  # after the unlinking: who locks a removed file looks again
  finally:
    _remove_empty(created)


@contextlib.contextmanager
def discarded_on(error: type[Exception], folder: str | Path) -> Iterator[None]:
  """Removes a folder that was missing before where the block raises an error of a kind."""
  missing = _missing(Path(folder))
  try:
    yield
  except error:
    if missing:
      shutil.rmtree(folder, ignore_errors=True)
      _remove_empty(missing)
    raise


def expect_own(folder: str | Path, mark: str, *, of: str) -> None:
  """Raises ValueError for a folder that holds files, but not the one that its command leaves first.

  Hidden files, locks among them, do not count.

  Args:
    folder: An output folder; it may be missing.
    mark: Name of the file that every folder of that command has.
    of: Whose folder is expected, in words, such as "a loop".
  """
  folder = Path(folder)
  if not folder.is_dir() or (folder / mark).exists():
    return
  found = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
  if found:
    raise ValueError(
      f"{folder} holds {found[0]} and no {mark}: expected a new or empty folder, or that of {of} "
      "to go on with; take another one with --out."
    )


def owner_of(folder: str | Path, *, name: str = FILE) -> dict[str, Any]:
  """Returns pid, host and time of the process whose lock file lies in a folder; empty without."""
  try:
    record = json.loads((Path(folder) / name).read_text())
  except (OSError, ValueError):
    return {}
  return record if isinstance(record, dict) else {}


def _create(folder: Path) -> list[Path]:
  """Creates a folder with its parents; returns those that were missing, the innermost first."""
  missing = _missing(folder)
  if not missing and not folder.is_dir():
    raise NotADirectoryError(f"{folder} is a file, expected a folder to write: name another one.")
  with files.explain_disk_full(folder):
    folder.mkdir(parents=True, exist_ok=True)
  return missing


def _missing(folder: Path) -> list[Path]:
  return [path for path in (folder, *folder.parents) if not path.exists()]


def _remove_empty(folders: list[Path]) -> None:
  """Removes folders, the innermost first, up to one that is not empty."""
  with contextlib.suppress(OSError):
    for path in folders:
      if path.exists():
        path.rmdir()


def _take_patiently(path: Path, patience: float) -> int:
  deadline = time.monotonic() + patience
  while True:
    try:
      return _take(path)
    except FolderInUseError:
      if time.monotonic() >= deadline:
        raise
      time.sleep(_POLL)


def _take(path: Path) -> int:
  """Returns the descriptor of the lock's file, which is locked and names this process."""
  for _ in range(_ATTEMPTS):
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
      _lock(descriptor, path)
      if not _is_same(descriptor, path):
        os.close(descriptor)
        continue
      _sign(descriptor, path)
      return descriptor
    except BaseException:
      with contextlib.suppress(OSError):
        os.close(descriptor)
      raise
  raise _in_use(path)


def _lock(descriptor: int, path: Path) -> None:
  """Locks an open file, or raises FolderInUseError."""
  try:
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
  except OSError as error:
    if error.errno in _TAKEN:
      raise _in_use(path) from None
    if error.errno not in _UNSUPPORTED:
      raise
    owner = owner_of(path.parent, name=path.name)
    if owner and not _is_dead(owner):
      raise _in_use(path) from None


def _sign(descriptor: int, path: Path) -> None:
  """Writes the owner into a lock's file; one that cannot hold it is removed."""
  record = {"pid": os.getpid(), "host": socket.gethostname(), "time": time.time()}
  try:
    os.ftruncate(descriptor, 0)
    os.write(descriptor, json.dumps(record).encode())
  except OSError:
    with contextlib.suppress(OSError):
      path.unlink()
    raise


def _is_same(descriptor: int, path: Path) -> bool:
  """Returns whether an open file is still the one of that name."""
  try:
    return os.path.samestat(os.fstat(descriptor), os.stat(path))
  except FileNotFoundError:
    return False


def _is_dead(owner: dict[str, Any]) -> bool:
  """Returns whether the process that a lock names has ended; unknown on another host."""
  if owner.get("host") != socket.gethostname():
    return False
  try:
    os.kill(int(owner.get("pid", 0)), 0)
  except ProcessLookupError:
    return True
  except PermissionError:
    return False
  return False


def _in_use(path: Path) -> FolderInUseError:
  owner = owner_of(path.parent, name=path.name)
  who = f"process {owner.get('pid')} on {owner.get('host')}" if owner else "another process"
  todo = "wait for it, stop it, or name another folder"
  if owner and owner.get("host") != socket.gethostname():
    todo += f" (if it is gone, remove {path})"
  return FolderInUseError(f"{path.parent} is being written by {who}: {todo}.")
