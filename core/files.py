"""Atomic writes: a file or folder appears under its name whole or not at all.

The content goes to a temporary sibling, which is renamed when it is complete; after an error the
sibling is removed and what was there before is untouched. A full disk or an exhausted quota is
raised as `DiskFullError`, one line for the user. A line is appended whole or not at all.
"""

import contextlib
import errno
import hashlib
import os
import shutil
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path

_REASONS = {
  errno.ENOSPC: "the disk is full",
  errno.EDQUOT: "the disk quota is used up",
  errno.EFBIG: "the limit of a file's size is reached",
}


class DiskFullError(OSError):
  """The disk, quota or file size is exhausted; the message is one line that names the path."""

  def __str__(self) -> str:
    return str(self.strerror)


def is_disk_full(error: BaseException) -> bool:
  """Returns whether an error means that the disk, the quota or the file's size is exhausted."""
  return isinstance(error, OSError) and error.errno in _REASONS


def check_writable(path: str | Path) -> None:
  """Raises OSError, naming `path`, where nothing can be made there: before hours of work for it.

  The folder that it will be in must exist; what is there under its name is untouched.
  """
  path = Path(path)
  probe = path.with_name(f".{path.name}.{os.getpid()}.probe")
  try:
    probe.touch()
    probe.unlink()
  except OSError as error:
    if error.errno in _REASONS:
      raise disk_full(path, error.errno) from error
    raise OSError(error.errno, error.strerror, str(path)) from error


@contextlib.contextmanager
def _under_its_name(partial: Path, path: Path) -> Iterator[None]:
  """Raises an OSError about a temporary path, or what is in it, with the name it stands for."""
  try:
    yield
  except DiskFullError:
    raise
  except OSError as error:
    named = Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | Path) else None
    if named is None or not named.is_relative_to(partial):
      raise
    where = path / named.relative_to(partial)
    raise OSError(error.errno, error.strerror, str(where)) from error


@contextlib.contextmanager
def explain_disk_full(path: str | Path) -> Iterator[None]:
  """Raises DiskFullError, naming `path`, where the block raises ENOSPC, EDQUOT or EFBIG."""
  try:
    yield
  except DiskFullError:
    raise
  except OSError as error:
    if error.errno not in _REASONS:
      raise
    raise disk_full(path, error.errno) from error


def disk_full(path: str | Path, number: int = errno.ENOSPC) -> DiskFullError:
  """Returns the error for a path that could not be written, of an error number."""
  reason = _REASONS[number]
  text = f"Could not write {path}: {reason}. Free some space and try again."
  return DiskFullError(number, text, str(path))


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
  """Yields a temporary path with the same suffix, for writers that take a file name.

  When the block ends, the temporary file is synchronised to disk and renamed to `path`.

  Raises:
    DiskFullError: The disk or the quota is exhausted.
    FileNotFoundError: The folder of `path` is missing, or the block wrote no file.
  """
  path = Path(path)
  owner = f"{os.getpid()}-{threading.get_native_id()}"
  partial = path.with_name(f".{path.stem}.{owner}.partial{path.suffix}")
  try:
    with explain_disk_full(path), _under_its_name(partial, path):
      yield partial
      with partial.open("rb") as stream:
        os.fsync(stream.fileno())
      partial.replace(path)
  finally:
    with contextlib.suppress(OSError):  # must not hide the error that is under way
      partial.unlink(missing_ok=True)


def write_atomically(path: str | Path, content: str | bytes) -> None:
  """Writes text (UTF-8) or bytes; see `atomic_path` for the errors."""
  with atomic_path(path) as partial:
    partial.write_bytes(content.encode() if isinstance(content, str) else content)


def append_line(path: str | Path, text: str) -> None:
  """Appends a line of text (UTF-8); after an error the file is as it was before.

  Raises:
    DiskFullError: The disk or the quota is exhausted.
  """
  path = Path(path)
  existed = path.exists()
  with explain_disk_full(path), path.open("ab", buffering=0) as stream:
    before, rest = stream.tell(), memoryview(f"{text}\n".encode())
    try:
      while rest:
        rest = rest[stream.write(rest) :]
    except OSError:
      stream.truncate(before)
      if not existed:
        path.unlink()
      raise


@contextlib.contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
  """Yields an empty temporary folder that replaces the folder `path` when the block ends.

  One process at a time may write a folder: the temporary folder of an interrupted one is removed.

  Raises:
    DiskFullError: The disk or the quota is exhausted.
  """
  path = Path(path)
  partial = path.with_name(f".{path.name}.partial")
  shutil.rmtree(partial, ignore_errors=True)
  try:
    with explain_disk_full(path), _under_its_name(partial, path):
      partial.mkdir(parents=True)
      yield partial
      replace_folder(partial, path)
  finally:
    shutil.rmtree(partial, ignore_errors=True)


def replace_folder(source: Path, target: Path) -> None:
  """Renames a folder to `target` on the same disk; an older folder or file there is removed."""
  retired = target.with_name(f".{target.name}.retired")
  _remove(retired)
  if target.exists():
    target.rename(retired)
  source.rename(target)
  _remove(retired)


def _remove(path: Path) -> None:
  """Removes a file, a link or a folder; what is not there or cannot be removed is left."""
  if path.is_dir() and not path.is_symlink():
    shutil.rmtree(path, ignore_errors=True)
  else:
    with contextlib.suppress(OSError):
      path.unlink(missing_ok=True)


def copy_atomically(source: Path, target: Path) -> None:
  """Copies a file or folder; an older target is replaced."""
  if source.is_dir():
    with atomic_folder(target) as partial:
      shutil.copytree(source, partial, dirs_exist_ok=True)
  else:
    with atomic_path(target) as partial:
      shutil.copyfile(source, partial)


def hash_path(path: str | Path, *, named: Iterable[Path] = ()) -> str:
  """Returns the SHA-256 of a file's content, or of all files below a folder with their names.

  Args:
    path: The file or folder. What is hidden below it (a name that begins with ".") does not count;
      folders that are linked below it do.
    named: Files that it names, which count with their names where they do not lie below it.

  Raises:
    FileNotFoundError: There is neither a file nor a folder.
  """
  path = Path(path)
  if not path.exists():
    raise FileNotFoundError(f"{path} does not exist; give an existing file or folder.")
  digest = hashlib.sha256()
  below = [path] if path.is_file() else sorted(_files_below(path))
  folder = path if path.is_dir() else path.parent
  for file in (*below, *sorted(set(named) - set(below))):
    if file != path:
      digest.update(os.fsencode(os.path.relpath(file, folder)))
    with file.open("rb") as stream:
      digest.update(hashlib.file_digest(stream, "sha256").digest())
  return digest.hexdigest()


def _files_below(folder: Path, above: frozenset[Path] = frozenset()) -> Iterator[Path]:
  """Yields all files below a folder but hidden ones; a link to a folder `above` it is passed by."""
  above |= {folder.resolve()}
  with contextlib.suppress(PermissionError):
    for path in folder.iterdir():
      if path.name.startswith("."):
        continue
      if path.is_file():
        yield path
      elif path.is_dir() and path.resolve() not in above:
        yield from _files_below(path, above)
