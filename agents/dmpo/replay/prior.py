"""Replay across experiments: transitions of earlier runs, mixed into batches at a fixed share.

Tirumala et al. 2024, "Replay across Experiments" (https://arxiv.org/abs/2311.15951). A folder holds
the environment's layout and either a replay's arrays (`replay.py`) or episodes, one `.npz` each
with a trajectory's arrays, such as a distillation's `data/`. The LSTM's states of another network
mean nothing to this one: a window that does not begin with its episode begins with zeros, and its
first steps only unroll the LSTM (burn-in; Kapturowski et al. 2019, "Recurrent Experience Replay in
Distributed Reinforcement Learning").

Shape letters: B trajectories, T observations, N observations in all.
"""

import logging
import zipfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.agents.dmpo.replay.features import FrozenEncoder
from nerf2real.agents.dmpo.replay.ring import Replay, open_stored, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.core.serialization import read_json, write_json

_log = logging.getLogger(__name__)
LAYOUT = "layout.json"
_FOLDERS = ("", "replay", "data")  # of a run's folder
_SPECS = (
  "image_shape",
  "state_names",
  "state_sizes",
  "privileged_names",
  "privileged_sizes",
  "action_size",
)


def write_layout(folder: Path, layout: Layout) -> None:
  """Writes the layout of the observations beside data that a later run may take."""
  write_json(folder / LAYOUT, layout)


class Segment(NamedTuple):
  """Consecutive observations."""

  begin: int  # the first one's index
  end: int  # one past the last one's
  is_start: bool  # whether an episode begins with it


class PriorData:
  """Transitions of earlier runs in memory; windows of them are drawn as from a replay."""

  def __init__(self, folder: Path, layout: Layout, *, max_steps: int):
    """Reads a folder.

    Args:
      folder: of the data, or of a run that holds them as `replay/` or `data/`.
      layout: this run's layout.
      max_steps: environment steps to take; of more, the last ones.

    Raises:
      ValueError: the folder holds no such data, or those of other observations or actions.
    """
    folder = _find(folder)
    _check_layout(folder, layout)
    names = tuple(trajectory_fields(layout, lstm_size=0))
    parts: list[Mapping[str, np.ndarray]] = []
    starts: list[bool] = []
    steps = 0
    for trajectory, is_start in _newest_first(folder, names):
      parts.append(trajectory)
      starts.append(is_start)
      steps += len(trajectory["reward"]) - 1
      if steps >= max_steps:
        break
    if not parts:
      raise ValueError(
        f"{folder} holds no transitions with {', '.join(names)}: collect them again."
      )
    self._arrays = {name: np.concatenate([p[name] for p in parts]) for name in names}
    ends = np.cumsum([len(part["reward"]) for part in parts]).tolist()
    begins = [0, *ends[:-1]]
    self._set_segments([Segment(*s) for s in zip(begins, ends, starts, strict=True)])

  def _set_segments(self, segments: list[Segment]) -> None:
    self._segments = segments
    counts = np.array([s.end - s.begin - 1 for s in self._segments])
    self._last_steps = np.cumsum(counts)
    self.steps = int(counts.sum())
    if not self.steps:
      raise ValueError("The prior data hold no transitions beyond the burn-in: lower burn_in.")

  def encode(self, encoder: FrozenEncoder, *, burn_in: int) -> None:
    """Replaces the pictures by what a frozen encoder makes of them.

    Args:
      encoder: its LSTM, if it has one, begins every segment with zeros.
      burn_in: observations after which its state counts as known where no episode begins; those
        before are not drawn.

    Raises:
      ValueError: nothing is left to be drawn.
    """
    images = self._arrays.pop("image")
    encoded = [encoder.encode(images[s.begin : s.end]) for s in self._segments]
    self._arrays[encoder.name] = np.concatenate(encoded)
    if encoder.has_memory:
      known = [s if s.is_start else Segment(s.begin + burn_in, s.end, True) for s in self._segments]
      self._set_segments([s for s in known if s.end - s.begin > 1])

  def sample(
    self, rng: np.random.Generator, batch_size: int, *, length: int, burn_in: int, lstm_size: int
  ) -> dict[str, np.ndarray]:
    """Draws windows about uniformly drawn transitions, as `Replay.sample` gives trajectories.

    Args:
      rng: source of the draws.
      batch_size: windows, B.
      length: most observations in a window, T.
      burn_in: steps that only unroll the LSTM, where an episode does not begin with the window.
      lstm_size: units of the LSTM, whose first state is zero; 0 without one.

    Returns:
      Arrays [B, T, ...], `last` [B] and `burn_in` [B].
    """
    frames = np.empty((batch_size, length), np.int64)
    last, burned = np.empty(batch_size, np.int32), np.zeros(batch_size, np.int32)
    for row, step in enumerate(rng.integers(self.steps, size=batch_size)):
      index = int(np.searchsorted(self._last_steps, step, side="right"))
      segment = self._segments[index]
      count = segment.end - segment.begin
      within = int(step) - int(self._last_steps[index] - (count - 1))  # of the segment's steps
      begin = int(np.clip(within - rng.integers(length - 1), 0, max(0, count - length)))
      last[row] = min(length, count - begin) - 1
      frames[row] = segment.begin + begin + np.minimum(np.arange(length), last[row])
      if lstm_size and not (segment.is_start and begin == 0):
        burned[row] = min(burn_in, last[row])
    batch = {name: array[frames] for name, array in self._arrays.items()}
    if lstm_size:
      zeros = np.zeros((batch_size, lstm_size), np.float32)
      batch |= {"lstm_hidden": zeros, "lstm_cell": zeros}
    return batch | {"last": last, "burn_in": burned}


def sample_mixed(
  replay: Replay,
  prior: PriorData,
  rng: np.random.Generator,
  *,
  batch_size: int,
  share: float,
  burn_in: int,
  lstm_size: int,
) -> dict[str, np.ndarray]:
  """Draws a batch from a replay and from prior data; see `PriorData.sample`.

  Args:
    replay: of this run.
    prior: of earlier ones.
    rng: source of the draws.
    batch_size: trajectories, B.
    share: of the prior data in the batches; its part of a trajectory is drawn.
    burn_in: steps that only unroll the LSTM; see `PriorData.sample`.
    lstm_size: units of the LSTM; 0 without one.
  """
  count = int(share * batch_size + rng.random())
  own = replay.sample(rng, batch_size - count) if count < batch_size else {}
  if own:
    own["burn_in"] = np.zeros(batch_size - count, np.int32)
  if not count:
    return own
  earlier = prior.sample(rng, count, length=replay.length, burn_in=burn_in, lstm_size=lstm_size)
  return {n: np.concatenate([own[n], a]) if own else a for n, a in earlier.items()}


def _find(folder: Path) -> Path:
  """The folder with the data in a run's folder, or itself."""
  found = [folder / name for name in _FOLDERS if (folder / name / LAYOUT).exists()]
  if not found:
    raise ValueError(
      f"{folder} holds no prior data: expected {LAYOUT} in it, in replay/ (a run with "
      "--replay-on-disk) or in data/ (a distillation)."
    )
  return found[0]


def _check_layout(folder: Path, layout: Layout) -> None:
  written = read_json(folder / LAYOUT, Layout)
  for name in _SPECS:
    found, expected = getattr(written, name), getattr(layout, name)
    if found != expected:
      raise ValueError(
        f"{folder} is of other observations or actions than this run: its {name} is {found}, "
        f"expected {expected}."
      )


def _newest_first(
  folder: Path, names: tuple[str, ...]
) -> Iterator[tuple[Mapping[str, np.ndarray], bool]]:
  """Yields trajectories and whether an episode begins with each."""
  stored = open_stored(folder)
  if stored is not None:
    missing = sorted(set(names) - set(stored))
    if missing:
      raise ValueError(f"{folder} is a replay without {', '.join(missing)}: it cannot be taken.")
    order = stored["origin"][:, 2]
    for slot in np.argsort(order)[::-1][: np.count_nonzero(order)]:
      count = int(stored["last"][slot]) + 1
      is_start = "lstm_cell" in stored and not stored["lstm_cell"][slot].any()
      yield {name: np.array(stored[name][slot, :count]) for name in names}, is_start
    return
  skipped = 0
  for path in sorted(folder.glob("[0-9]*.npz"), reverse=True):
    episode = _read_episode(path, names)
    if episode is None:
      skipped += 1
    elif len(episode["reward"]) > 1:
      yield episode, True
  if skipped:
    _log.warning("%s: %d episodes lack an array of %s.", folder, skipped, ", ".join(names))


def read_arrays(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
  """Reads the arrays of an episode's file.

  Args:
    path: the file.
    names: of the arrays that are wanted, of which those that are there are read; None for all.

  Raises:
    ValueError: it is damaged, or another file.
  """
  try:
    with np.load(path, allow_pickle=False) as stored:
      return {name: stored[name] for name in stored.files if names is None or name in names}
  except (zipfile.BadZipFile, EOFError, ValueError) as error:
    raise ValueError(f"{path} is no episode: {error}") from error


def _read_episode(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray] | None:
  """Reads an episode of N observations and as many transitions; None if it lacks an array.

  What followed the last action is not stored: the last observation stands for it where the episode
  terminated, for nothing is read from a terminal one, and the transition is left out elsewhere.
  """
  episode = read_arrays(path, names)
  if not set(names) <= set(episode):
    return None
  if len(episode["discount"]) and episode["discount"][-1] == 0:
    return {name: np.concatenate([array, array[-1:]]) for name, array in episode.items()}
  return episode
