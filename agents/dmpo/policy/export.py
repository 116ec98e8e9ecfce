"""A policy as one folder that an actor, the evaluator and the robot load with NumPy alone.

`policy.npz` holds the arrays by name, `policy.json` the layout, the settings and the digest of the
arrays. Each file is replaced as a whole; by the digest the two belong together.
"""

import dataclasses
import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.core import files
from nerf2real.core.serialization import from_plain, to_plain

FORMAT_VERSION = 1
_ARRAYS, RECORD = "policy.npz", "policy.json"
_ENTRIES = ("environment", "layout", "settings", "info", "sha256")


@dataclasses.dataclass(frozen=True)
class ExportedPolicy:
  """A loaded policy with what is known of it."""

  policy: Policy
  layout: Layout
  environment: str
  """The name it was trained on."""
  history: int
  """Observations that the agent stacks."""
  info: dict[str, Any]
  """Counters and settings of the run."""


def export_policy(
  folder: Path,
  parameters: Mapping[str, np.ndarray],
  *,
  layout: Layout,
  environment: str,
  settings: Mapping[str, Any],
  info: Mapping[str, Any],
) -> None:
  """Writes a policy.

  Args:
    folder: where to; what it holds of an older policy is replaced.
    parameters: flat named arrays, `training_state.served_parameters`.
    layout: the environment's layout.
    environment: the environment's name.
    settings: the agent's settings as plain values, `to_plain(config)`.
    info: counters such as steps and updates, and the return where it is known.
  """
  folder.mkdir(parents=True, exist_ok=True)
  buffer = io.BytesIO()
  # The policy alone is enough to act; a belief goes along where there is one.
  arrays: dict[str, Any] = {name: np.asarray(array) for name, array in parameters.items()}
  np.savez(buffer, **arrays)
  data = buffer.getvalue()
  record = {
    "format_version": FORMAT_VERSION,
    "environment": environment,
    "layout": to_plain(layout),
    "settings": dict(settings),
    "info": dict(info),
    "sha256": hashlib.sha256(data).hexdigest(),
  }
  files.write_atomically(folder / _ARRAYS, data)
  files.write_atomically(folder / RECORD, json.dumps(record, indent=1))


def load_policy(folder: Path | str) -> ExportedPolicy:
  """Loads a policy that `export_policy` wrote.

  Raises:
    ValueError: if the folder holds none, one of another format, or files that do not match.
  """
  record, parameters = _read(Path(folder))
  try:
    network, history = record["settings"]["network"], record["settings"]["history"]
    spreads = {name: network[name] for name in ("init_stddev", "min_stddev")}
  except (KeyError, TypeError) as error:
    raise ValueError(
      f"{folder} has other settings than an agent's ({error}): export it again."
    ) from error
  return ExportedPolicy(
    policy=Policy(parameters, **spreads),
    layout=from_plain(record["layout"], Layout, source=Path(folder) / RECORD),
    environment=record["environment"],
    history=history,
    info=record["info"],
  )


def check_beginning(folder: Path | str, layout: Layout) -> None:
  """Checks that what a policy observes and does is what an environment gives and takes.

  Args:
    folder: of an exported policy that a run is to begin with.
    layout: the environment's.

  Raises:
    ValueError: it is not, or as `load_policy` does.
  """
  found_layout = load_policy(folder).layout
  for name in ("image_shape", "state_names", "state_sizes", "action_size"):
    found, expected = getattr(found_layout, name), getattr(layout, name)
    if found != expected:
      raise ValueError(
        f"{folder} cannot be begun with: its {name} is {found}, this environment's {expected}."
      )


def load_arrays(folder: Path | str) -> dict[str, np.ndarray]:
  """Loads the flat named arrays of a policy; raises ValueError as `load_policy` does."""
  return _read(Path(folder))[1]


def read_record(folder: Path) -> dict[str, Any]:
  """Returns what is known of an exported policy besides its arrays, as `export_policy` wrote it.

  Raises:
    ValueError: the folder holds no policy, a damaged one, or one of another format.
  """
  path = folder / RECORD
  if not path.is_file():
    raise ValueError(f"{folder} holds no {RECORD}: give the folder of an exported policy.")
  try:
    record = json.loads(path.read_text())
  except ValueError as error:
    raise ValueError(f"{path} is damaged ({error}): export the policy again.") from error
  version = record.get("format_version") if isinstance(record, dict) else None
  if version != FORMAT_VERSION:
    raise ValueError(
      f"{folder} is of format {version}, expected {FORMAT_VERSION}: export it again with this "
      "version."
    )
  missing = [name for name in _ENTRIES if name not in record]
  if missing:
    raise ValueError(f"{path} lacks {', '.join(missing)}: export the policy again.")
  return record


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
  record = read_record(folder)
  if not (folder / _ARRAYS).is_file():
    raise ValueError(f"{folder} holds no {_ARRAYS} beside its {RECORD}: export it again.")
  data = (folder / _ARRAYS).read_bytes()
  if hashlib.sha256(data).hexdigest() != record["sha256"]:
    raise ValueError(f"{folder}: the arrays are not those of {RECORD}; export it again.")
  with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
    return record, {name: arrays[name] for name in arrays.files}
