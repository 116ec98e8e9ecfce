"""The data set of a distillation: labelled episodes, in files and in memory.

Every episode is one file that is written whole, so that a killed learner loses none that it has
acknowledged; `Dataset` reads them again when it is opened. In memory frames lie one after another
in arrays of fixed capacity, which the system commits as they fill.

Shape letters: N frames, B streams, T steps of an unroll.
"""

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nerf2real.agents.distill.teacher import COMMAND_SIZE
from nerf2real.agents.dmpo.replay.prior import read_arrays, write_layout
from nerf2real.agents.dmpo.specs import BALL, POSE_SIZE, Layout
from nerf2real.core import files

BALL_SIZE = 3  # x ahead [m], y to the left [m] of the robot, pan of its head [rad]
_UNROLL_FIELDS = ("state", "label", "command", "pose", "goal_distance", "ball")


class Span(NamedTuple):
  """An episode's frames: first and one past the last."""

  begin: int
  end: int


def fields(layout: Layout) -> dict[str, tuple[tuple[int, ...], type]]:
  """Arrays of an episode by name: shape of a frame and dtype.

  `label` and `command` are the teacher's, `pose` the truth, `goal_distance` [m] is how far the
  goal is, `driver` who drove: 0 the teacher, 1 the student, 2 a detour.
  """
  if layout.image_shape is None:
    raise ValueError("A distillation needs pictures: give the environment an image_size.")
  kept: dict[str, tuple[tuple[int, ...], type]] = {
    "image": (layout.image_shape, np.uint8),
    "state": ((layout.state_size,), np.float32),
    "label": ((layout.action_size,), np.float32),
    "command": ((COMMAND_SIZE,), np.float32),
    "pose": ((POSE_SIZE,), np.float32),
    "goal_distance": ((), np.float32),
    "driver": ((), np.uint8),
  }
  if layout.privileged_column(BALL) is not None:
    kept["ball"] = ((BALL_SIZE,), np.float32)
  return kept


def transition_fields(layout: Layout) -> dict[str, tuple[tuple[int, ...], type]]:
  """Further arrays of an episode, of which the files alone make use: they are a later DMPO run's
  prior data. `action` was applied at a step, `reward` and `discount` followed it."""
  return {
    "action": ((layout.action_size,), np.float32),
    "reward": ((), np.float32),
    "discount": ((), np.float32),
    "privileged": ((layout.privileged_size,), np.float32),
  }


class Dataset:
  """Episodes in the order of their arrival; every `holdout`-th is for validation.

  One thread may insert while another reads: what `spans` names is complete.
  """

  def __init__(self, folder: Path, layout: Layout, *, capacity: int, holdout: int):
    """Opens a data set and reads the episodes that its folder holds.

    Args:
      folder: of the files; made if it is missing.
      layout: the environment's layout.
      capacity: frames at most; later episodes are refused.
      holdout: every episode of that number is held out.
    """
    self._folder = folder
    self._fields = fields(layout)
    self._written = self._fields | transition_fields(layout)
    self._holdout = holdout
    self._capacity = capacity
    self._lock = threading.Lock()
    self.arrays: dict[str, np.ndarray] = {
      name: np.empty((capacity, *shape), dtype) for name, (shape, dtype) in self._fields.items()
    }
    self._spans: list[Span] = []
    self._origins: list[tuple[int, int]] = []
    folder.mkdir(parents=True, exist_ok=True)
    write_layout(folder, layout)
    for path in sorted(folder.glob("[0-9]*.npz")):
      self._read(path)

  @property
  def frames(self) -> int:
    """Frames held, N."""
    spans = self._spans
    return spans[-1].end if spans else 0

  @property
  def origins(self) -> list[tuple[int, int]]:
    """(Actor's key, number) of every episode, as `insert` was given them."""
    with self._lock:
      return list(self._origins)

  def take(self, frames: np.ndarray) -> dict[str, np.ndarray]:
    """Returns what an unroll needs besides pictures, at frames of any shape."""
    return {name: self.arrays[name][frames] for name in _UNROLL_FIELDS if name in self.arrays}

  def spans(self, *, held_out: bool) -> list[Span]:
    """Returns the episodes to train on, or those held out."""
    with self._lock:
      return [s for i, s in enumerate(self._spans) if (i % self._holdout == 1) == held_out]

  def insert(self, episode: Mapping[str, np.ndarray], key: int, number: int) -> int:
    """Writes and keeps an episode; returns its frames.

    Args:
      episode: arrays of `fields` and `transition_fields`, of one length.
      key: of the actor that made it.
      number: the episode's, among that actor's.

    Raises:
      ValueError: arrays are missing or of another shape, or the capacity is reached.
      OSError: it cannot be written.
    """
    frames = self._check(episode, self._written)
    name = f"{len(self._spans):06d}_{key:016x}_{number}.npz"
    with files.atomic_path(self._folder / name) as path:
      np.savez(path, **{name: episode[name] for name in self._written})  # type: ignore[arg-type]
    self._append(episode, frames, (key, number))
    return frames

  def _check(self, episode: Mapping[str, np.ndarray], wanted: Mapping[str, Any]) -> int:
    missing = sorted(set(wanted) - set(episode))
    if missing:
      raise ValueError(f"An episode lacks {missing}.")
    frames = len(episode["state"])
    for name, (shape, dtype) in wanted.items():
      array = episode[name]
      if array.shape != (frames, *shape) or array.dtype != dtype:
        raise ValueError(
          f"{name}: expected {np.dtype(dtype)} {(frames, *shape)}, found {array.dtype} "
          f"{array.shape}."
        )
    if self.frames + frames > self._capacity:
      raise ValueError(f"The data set holds its {self._capacity} frames.")
    return frames

  def _append(self, episode: Mapping[str, np.ndarray], frames: int, origin: tuple[int, int]):
    begin = self.frames
    for name in self._fields:
      self.arrays[name][begin : begin + frames] = episode[name]
    with self._lock:
      self._origins.append(origin)
      self._spans.append(Span(begin, begin + frames))

  def _read(self, path: Path) -> None:
    try:
      episode = read_arrays(path, self._fields)
      frames = self._check(episode, self._fields)
      _, key, number = path.stem.split("_")
      origin = int(key, 16), int(number)
    except ValueError as error:
      raise ValueError(f"{path} is no episode of this run: {error}") from error
    self._append(episode, frames, origin)


class Unroll(NamedTuple):
  """Frames of recurrent unrolls."""

  frames: np.ndarray  # int [B, T], into the data set's arrays
  begins: np.ndarray  # float32 [B, T]: 1 where an episode begins, and the state with it


class Streams:
  """Plays episodes in B streams; every unroll goes on where the last one ended."""

  def __init__(self, count: int, length: int, *, rng: np.random.Generator):
    """Creates streams.

    Args:
      count: of streams, B.
      length: of an unroll, T [steps].
      rng: chooses the episodes.
    """
    self._length = length
    self._rng = rng
    self._rest = [Span(0, 0)] * count

  def next(self, spans: list[Span]) -> Unroll:
    """Returns the next unroll; an episode that ended is followed by a drawn one of `spans`."""
    shape = len(self._rest), self._length
    frames, begins = np.empty(shape, np.int64), np.zeros(shape, np.float32)
    for stream, span in enumerate(self._rest):
      filled = 0
      while filled < self._length:
        if span.begin >= span.end:
          span = self._draw(spans, anywhere=self._rest[stream].end == 0)
          begins[stream, filled] = 1.0
        count = min(self._length - filled, span.end - span.begin)
        frames[stream, filled : filled + count] = np.arange(span.begin, span.begin + count)
        filled += count
        span = Span(span.begin + count, span.end)
      self._rest[stream] = span
    return Unroll(frames, begins)

  def _draw(self, spans: list[Span], *, anywhere: bool) -> Span:
    """Draws an episode; a stream's first one from anywhere in it, so that streams differ."""
    span = spans[int(self._rng.integers(len(spans)))]
    if not anywhere:
      return span
    return Span(int(self._rng.integers(span.begin, span.end)), span.end)
