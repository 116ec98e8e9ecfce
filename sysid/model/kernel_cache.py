"""Keeps numba's cache of compiled kernels honest.

numba compiles the functions that a kernel calls into the kernel, but looks only at the kernel's own
file to see whether a cached copy is current. Here the copies go when any of the files changed.
"""

import contextlib
import hashlib
from collections.abc import Sequence
from pathlib import Path

import numba

_DIGEST = "kernels.sha256"


def discard_stale(folder: Path, sources: Sequence[str], used: Sequence[Path]) -> bool:
  """Deletes the cached kernels of modules unless they were made from these very sources.

  Args:
    folder: Folder of the modules; numba's cache is its `__pycache__`.
    sources: Names of all modules that take part, without ".py".
    used: Files elsewhere whose functions are compiled into these.

  Returns:
    Whether the cache may be used: False where the folder cannot be written to.
  """
  digest = hashlib.sha256(numba.__version__.encode())
  for name in sorted(sources):
    digest.update((folder / f"{name}.py").read_bytes())
  for path in used:
    digest.update(path.read_bytes())
  cache = folder / "__pycache__"
  record = cache / _DIGEST
  with contextlib.suppress(OSError):
    if record.exists() and record.read_text() == digest.hexdigest():
      return True
  try:
    cache.mkdir(exist_ok=True)
    for name in sources:
      for stale in (*cache.glob(f"{name}.*.nbi"), *cache.glob(f"{name}.*.nbc")):
        stale.unlink(missing_ok=True)
    record.write_text(digest.hexdigest())
  except OSError:
    return False
  return True
