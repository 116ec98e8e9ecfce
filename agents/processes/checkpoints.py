"""Checkpoints of the learner: orbax folders, the newest ones and the best, each whole or absent.

A folder holds the training state and, as JSON, the settings and counters it was made with. It is
written under another name and renamed when it is complete, so that a full disk or a kill leaves the
older ones as they were.
"""

import json
import logging
import re
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from nerf2real.agents.dmpo.training_state import TrainingState

NEWEST, BEST = "newest", "best"
_KEEP = {NEWEST: 2, BEST: 1}
_SWEEPS, _SWEEP_PAUSE = 20, 0.05  # s; chosen: writes that are under way end within a second
_NAME = re.compile(r"(newest|best)-\d{10}-\d{12}(-\d{8})?")  # kind, updates, steps, seconds


class CheckpointError(RuntimeError):
  """A checkpoint could not be written or read; the message is one line for the user."""


class Checkpoints:
  """The checkpoints of one run."""

  def __init__(self, folder: Path):
    self._folder = folder.absolute()
    self._folder.mkdir(parents=True, exist_ok=True)
    # orbax reports every step of a save, and its threads every error before it is raised here.
    logging.getLogger("absl").setLevel(logging.CRITICAL)
    self._checkpointer = ocp.Checkpointer(ocp.CompositeCheckpointHandler())
    self._sweep()

  def _sweep(self) -> None:
    """Removes what an interrupted save has left.

    A failed save raises its first error while writes of other arrays go on in threads; a folder
    that gets a file while it is removed stays, and is removed again.
    """
    for _ in range(_SWEEPS):
      left = [p for p in self._folder.iterdir() if p.is_dir() and not _NAME.fullmatch(p.name)]
      if not left:
        return
      for path in left:
        shutil.rmtree(path, ignore_errors=True)
      time.sleep(_SWEEP_PAUSE)

  def list(self, kind: str = NEWEST) -> list[Path]:
    """The whole checkpoints of a kind, oldest first."""
    paths = [p for p in self._folder.iterdir() if _NAME.fullmatch(p.name)]
    return sorted(p for p in paths if p.name.startswith(f"{kind}-"))

  def save(self, state: TrainingState, info: Mapping[str, Any], *, kind: str = NEWEST) -> Path:
    """Writes a checkpoint and removes older ones of its kind.

    Args:
      state: the training state.
      info: settings and counters; what JSON can hold. `steps` (environment steps) and `seconds`
        (time of the run) name the folder: a part of a run without a step leaves its time.
      kind: NEWEST or BEST.

    Raises:
      CheckpointError: if it cannot be written, such as on a full disk; older ones stay.
    """
    seconds = int(info.get("seconds", 0))
    steps = f"{kind}-{int(state.steps):010d}-{info['steps']:012d}"
    for newest in self.list(kind)[-1:]:
      last = int(newest.name.removeprefix(steps)[1:] or 0) if newest.name.startswith(steps) else -1
      if seconds <= last:
        if _same(_read_record(newest), info):
          return newest
        seconds = last + 1  # what has changed within a second, as which result is the best
    path = self._folder / f"{steps}-{seconds:08d}"
    try:
      self._checkpointer.save(
        path,
        args=ocp.args.Composite(
          state=ocp.args.StandardSave(_named(state)),
          info=ocp.args.JsonSave({"info": dict(info), "shapes": _shapes(state)}),
        ),
      )
    except Exception as error:  # orbax and tensorstore raise many kinds, some of them bare
      self._sweep()
      shutil.rmtree(path, ignore_errors=True)
      lines = str(error).strip().splitlines()
      reason = lines[0][:200] if lines else type(error).__name__
      if "No space left" in str(error):
        reason = "the disk is full"
      older = ", ".join(p.name for p in self.list(kind)) or "none"
      free = shutil.disk_usage(self._folder).free / 1e6
      raise CheckpointError(
        f"Could not write the checkpoint {path.name}: {reason}. Older ones are untouched "
        f"({older}). Free space left: {free:.0f} MB; make room."
      ) from error
    for old in self.list(kind)[: -_KEEP[kind]]:
      shutil.rmtree(old, ignore_errors=True)
    return path

  def restore(self, example: TrainingState) -> tuple[TrainingState, dict[str, Any]]:
    """Reads the newest checkpoint.

    Args:
      example: a state of the shapes to be read.

    Raises:
      CheckpointError: if there is none, or it does not fit the settings.
    """
    paths = self.list()[-1:]
    if not paths:
      raise CheckpointError(f"{self._folder} holds no checkpoint: start without --resume.")
    record = _read_record(paths[0])
    if record is None or record["shapes"] != _shapes(example):
      raise CheckpointError(
        f"{paths[0]} holds a state of other shapes than these settings give: resume with the "
        "settings and the environment of the run that wrote it."
      )
    try:
      restored = self._checkpointer.restore(
        paths[0],
        args=ocp.args.Composite(
          state=ocp.args.StandardRestore(jax.tree.map(_abstract, _named(example)))
        ),
      )
    except (ValueError, KeyError, TypeError, OSError) as error:
      raise CheckpointError(
        f"Could not read {paths[0]}: {str(error).splitlines()[0][:300]}. Remove it to go on from "
        "an older one."
      ) from error
    leaves = jax.tree.leaves(restored["state"])
    return jax.tree.unflatten(jax.tree.structure(example), leaves), record["info"]

  def close(self) -> None:
    """Frees orbax's threads."""
    self._checkpointer.close()


def read_info(run: Path) -> dict[str, Any] | None:
  """The settings and counters of a run's newest checkpoint; None if it has none."""
  folder = run / "checkpoints"
  names = sorted(p for p in folder.glob("newest-*") if _NAME.fullmatch(p.name))
  if not names:
    return None
  record = _read_record(names[-1])
  return None if record is None else record["info"]


def _read_record(checkpoint: Path) -> dict[str, Any] | None:
  path = checkpoint / "info" / "metadata"
  if not path.exists():
    return None
  try:
    return json.loads(path.read_text())
  except ValueError as error:
    raise CheckpointError(
      f"{path} is damaged ({error}): remove {checkpoint} to go on from an older one."
    ) from error


def _same(record: dict[str, Any] | None, info: Mapping[str, Any]) -> bool:
  """Tells whether a checkpoint was made with settings and counters, but for the time."""
  if record is None:
    return False
  now = json.loads(json.dumps(dict(info)))
  return {**record["info"], "seconds": None} == {**now, "seconds": None}


def _shapes(state: TrainingState) -> list[Any]:
  return [[str(leaf.dtype), list(leaf.shape)] for leaf in jax.tree.leaves(state)]


def _named(state: TrainingState) -> dict[str, Any]:
  """Leaves by their place in the state: independent of the classes that hold them."""
  return {f"{i:05d}": leaf for i, leaf in enumerate(jax.tree.leaves(state))}


def _abstract(leaf: Any) -> Any:
  return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)
