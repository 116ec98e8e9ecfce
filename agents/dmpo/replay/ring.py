"""The replay: a ring of trajectories in plain arrays, in memory or in files of the run's folder.

Trajectories shorter than T are padded with zeros; `last` is the index of a trajectory's last
observation, so that it holds `last` transitions (environment steps). Stored on disk, the arrays are
memory maps: what was inserted survives the death of the process, and every entry holds the actor
and the number that it came with, so that nothing is inserted twice after a restart. The files are
sparse and grow with what is inserted; an entry's space is reserved before it is written, so that a
full disk is an OSError and not the signal SIGBUS.
"""

import json
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.agents.dmpo.specs import Layout
from nerf2real.core import files

_INDEX_FILE = "index.json"
_ORIGIN = "origin"  # uint64 [capacity, 3]: actor's key, trajectory's number, insertion number + 1


class Field(NamedTuple):
  """Shape and type of one array of a trajectory."""

  shape: tuple[int, ...]  # without the time axis
  dtype: str
  per_step: bool = True  # False: one value a trajectory, such as the LSTM's first state


def trajectory_fields(layout: Layout, *, lstm_size: int) -> dict[str, Field]:
  """What a trajectory consists of, for an environment and a policy (lstm_size 0: no LSTM).

  `reward` and `discount` at step t follow the action at step t; those of the last step are zero.
  """
  fields = {
    "state": Field((layout.state_size,), "float32"),
    "privileged": Field((layout.privileged_size,), "float32"),
    "action": Field((layout.action_size,), "float32"),
    "reward": Field((), "float32"),
    "discount": Field((), "float32"),
  }
  if layout.image_shape is not None:
    fields["image"] = Field(layout.image_shape, "uint8")
  if lstm_size:
    fields["lstm_hidden"] = Field((lstm_size,), "float32", per_step=False)
    fields["lstm_cell"] = Field((lstm_size,), "float32", per_step=False)
  return fields


def check_trajectory(
  trajectory: Mapping[str, np.ndarray], fields: Mapping[str, Field], *, length: int
) -> int:
  """Checks names, types, shapes and finiteness of a trajectory; returns its observations.

  Raises:
    ValueError: with what was found and what was expected.
  """
  if set(trajectory) != set(fields):
    raise ValueError(f"Expected arrays {sorted(fields)}, found {sorted(trajectory)}.")
  steps = trajectory["reward"].shape[0] if trajectory["reward"].ndim else 0
  if not 2 <= steps <= length:
    raise ValueError(f"Expected 2 to {length} steps in a trajectory, found {steps}.")
  for name, field in fields.items():
    array = trajectory[name]
    shape = (steps, *field.shape) if field.per_step else field.shape
    if array.shape != shape or array.dtype != field.dtype:
      raise ValueError(
        f"{name}: expected {field.dtype} {shape}, found {array.dtype} {array.shape}."
      )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
      raise ValueError(f"{name} holds numbers that are not finite.")
  return steps


class Replay:
  """A ring of trajectories with uniform sampling; safe to use from several threads."""

  def __init__(
    self,
    fields: Mapping[str, Field],
    *,
    length: int,
    capacity_steps: int,
    folder: Path | None = None,
  ):
    """Creates an empty replay, or opens the one in folder.

    Args:
      fields: what a trajectory consists of.
      length: most observations in a trajectory, T.
      capacity_steps: environment steps that the ring holds.
      folder: where to keep the arrays as files; None keeps them in memory.

    Raises:
      ValueError: if the folder holds a replay of other shapes.
    """
    self.length = length
    self.capacity = max(1, capacity_steps // (length - 1))
    self._fields = dict(fields)
    self._lock = threading.Lock()
    shapes = {
      name: (
        (self.capacity, length, *f.shape) if f.per_step else (self.capacity, *f.shape),
        f.dtype,
      )
      for name, f in self._fields.items()
    }
    shapes |= {"last": ((self.capacity,), "int32"), _ORIGIN: ((self.capacity, 3), "uint64")}
    self.on_disk = folder is not None
    existing = folder is not None and _check_index(folder, shapes)
    self._arrays = {
      name: _open_array(folder, name, shape, dtype, existing)
      for name, (shape, dtype) in shapes.items()
    }
    if folder is not None and not existing:
      index = {name: [list(shape), dtype] for name, (shape, dtype) in shapes.items()}
      files.write_atomically(folder / _INDEX_FILE, json.dumps(index))
    order = self._arrays[_ORIGIN][:, 2]
    self.inserted = int(order.max(initial=0))  # trajectories ever inserted into this ring
    self._size = int(np.count_nonzero(order))
    self._steps = int(self._arrays["last"][order > 0].sum())

  @property
  def size(self) -> int:
    """Trajectories held."""
    return self._size

  @property
  def steps(self) -> int:
    """Environment steps held."""
    return self._steps

  def insert(
    self, trajectory: Mapping[str, np.ndarray], *, actor: int = 0, number: int = 0
  ) -> None:
    """Inserts a checked trajectory; the oldest goes when the ring is full.

    Args:
      trajectory: arrays as `check_trajectory` accepts them.
      actor: key of the actor that made it.
      number: its number among that actor's.

    Raises:
      OSError: the disk is full; what the replay held is untouched.
    """
    with self._lock:
      slot = self.inserted % self.capacity
      self._reserve(slot)
      origin = self._arrays[_ORIGIN]
      if origin[slot, 2]:
        self._steps -= int(self._arrays["last"][slot])
        self._size -= 1
        origin[slot, 2] = 0  # not whole until the last line below
      steps = trajectory["reward"].shape[0]
      for name, field in self._fields.items():
        array = self._arrays[name]
        if field.per_step:
          array[slot, :steps] = trajectory[name]
          array[slot, steps:] = 0
        else:
          array[slot] = trajectory[name]
      self._arrays["last"][slot] = steps - 1
      self.inserted += 1
      origin[slot] = (actor, number, self.inserted)
      self._size += 1
      self._steps += steps - 1

  def _reserve(self, slot: int) -> None:
    if not hasattr(os, "posix_fallocate"):  # not on macOS
      return
    for array in self._arrays.values():
      if isinstance(array, np.memmap):
        size = array.nbytes // self.capacity
        descriptor = os.open(str(array.filename), os.O_RDWR)
        try:
          os.posix_fallocate(descriptor, slot * size, size)
        finally:
          os.close(descriptor)

  def sample(
    self, rng: np.random.Generator, batch_size: int, *, names: Sequence[str] | None = None
  ) -> dict[str, np.ndarray]:
    """Draws trajectories uniformly with replacement: arrays [B, T, ...], and `last` [B].

    Args:
      rng: source of the draws.
      batch_size: trajectories, B.
      names: of the arrays to give; None for all.
    """
    with self._lock:
      if not self._size:
        raise ValueError("The replay is empty: insert trajectories before sampling.")
      # The whole entries are the `size` most recent ones.
      newest = self.inserted - 1 - rng.integers(self._size, size=batch_size)
      slots = newest % self.capacity
      names = names or [name for name in self._arrays if name != _ORIGIN]
      return {name: np.array(self._arrays[name][slots]) for name in names}

  def steps_after(self, inserted: int) -> int:
    """Environment steps of the entries that came after the first `inserted` ones."""
    with self._lock:
      return int(self._arrays["last"][self._arrays[_ORIGIN][:, 2] > inserted].sum())

  def origins(self) -> list[tuple[int, int]]:
    """Returns (actor, number) of every entry."""
    with self._lock:
      origin = self._arrays[_ORIGIN]
      return [(int(a), int(n)) for a, n, order in origin if order]

  def flush(self) -> None:
    """Writes memory maps to the disk."""
    for array in self._arrays.values():
      if isinstance(array, np.memmap):
        array.flush()


def open_stored(folder: Path) -> dict[str, np.ndarray] | None:
  """Opens the arrays of a folder's replay for reading, `origin` among them; None without one.

  The entries that are whole have a number above 0 in `origin[:, 2]`, which rises as they came.
  """
  if not (folder / _INDEX_FILE).exists():
    return None
  index = json.loads((folder / _INDEX_FILE).read_text())
  return {
    name: np.zeros(shape, dtype)
    if 0 in shape
    else np.memmap(folder / f"{name}.raw", dtype, "r", shape=tuple(shape))
    for name, (shape, dtype) in index.items()
  }


def _check_index(folder: Path, shapes: Mapping[str, tuple]) -> bool:
  """Returns whether the folder holds a replay; raises ValueError if it is another one."""
  folder.mkdir(parents=True, exist_ok=True)
  if not (folder / _INDEX_FILE).exists():
    return False
  index = json.loads((folder / _INDEX_FILE).read_text())
  found = {name: (tuple(shape), dtype) for name, (shape, dtype) in index.items()}
  if found != dict(shapes):
    raise ValueError(
      f"{folder} holds a replay of other shapes than this run's: remove it, or resume with the "
      "settings and the environment that wrote it."
    )
  return True


def _open_array(
  folder: Path | None, name: str, shape: tuple[int, ...], dtype: str, existing: bool
) -> np.ndarray:
  if folder is None or 0 in shape:  # an array without numbers cannot be mapped
    return np.zeros(shape, dtype)
  path = folder / f"{name}.raw"
  return np.memmap(path, dtype, "r+" if existing else "w+", shape=shape)
