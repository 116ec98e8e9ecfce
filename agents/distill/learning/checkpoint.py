"""The learner's saved state: one file, written whole."""

import contextlib
import dataclasses
import io
import json
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.agents.distill.learning.updates import TrainingState
from nerf2real.core import files
from nerf2real.core.serialization import from_plain, to_plain

# The supervisor resumes a learner that left a `newest-*` among its run's checkpoints.
STATE = Path("checkpoints") / "newest-student.npz"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Counters:
  """What a saved state holds besides arrays."""

  updates: int = 0
  elapsed: float = 0.0
  """s of training, over all parts of the run."""
  begun: int | None = None
  """Frames at which the run's first own student was published."""
  seed: int = 0
  """The run's."""


def save_state(path: Path, state: TrainingState, counters: Counters) -> None:
  """Writes a training state whole: its leaves in order, and the counters as JSON."""
  leaves = {f"leaf{i:04d}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(state))}
  about = np.frombuffer(json.dumps(to_plain(counters)).encode(), np.uint8)
  buffer = io.BytesIO()
  np.savez(buffer, counters=about, **leaves)  # type: ignore[arg-type]
  path.parent.mkdir(parents=True, exist_ok=True)
  files.write_atomically(path, buffer.getvalue())


def load_state(path: Path, *, like: TrainingState) -> tuple[TrainingState, Counters]:
  """Reads what `save_state` wrote.

  Args:
    path: the file.
    like: a state of the same settings.

  Raises:
    ValueError: it is damaged, or of other settings.
  """
  with _opened(path) as stored:
    found = [stored[name] for name in sorted(n for n in stored.files if n.startswith("leaf"))]
  expected, structure = jax.tree.flatten(like)
  if [x.shape for x in found] != [x.shape for x in expected]:
    raise ValueError(f"{path} is of other networks than the settings: take those it began with.")
  return jax.tree.unflatten(structure, [jnp.asarray(x) for x in found]), load_counters(path)


def load_counters(path: Path) -> Counters:
  """Reads the counters of what `save_state` wrote; raises ValueError where it is damaged."""
  with _opened(path) as stored:
    return from_plain(json.loads(stored["counters"].tobytes()), Counters)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
  """Opens a saved state; a file that was cut off or is another one is one clear error."""
  try:
    with np.load(path, allow_pickle=False) as stored:
      yield stored
  except (zipfile.BadZipFile, zlib.error, EOFError, KeyError) as error:
    raise ValueError(
      f"{path} is damaged ({error}): put a copy of it there, or begin anew in another folder."
    ) from error
