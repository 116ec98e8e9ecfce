"""A policy as one folder that an actor, the evaluator and the robot load with NumPy alone.

`policy.npz` holds the arrays by name, `policy.json` the layout, the settings and the digest of the
arrays. Each file is replaced as a whole; the digest tells if the two belong together.
"""

import dataclasses
import hashlib
import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.agents.dmpo.inference import Policy
from nerf2real.agents.dmpo.specs import Layout

FORMAT_VERSION = 1
_ARRAYS, _RECORD = "policy.npz", "policy.json"


@dataclasses.dataclass(frozen=True)
class ExportedPolicy:
  """A loaded policy with what is known of it."""

  policy: Policy
  layout: Layout
  environment: str  # the name it was trained on
  history: int  # observations that the agent stacks
  info: dict[str, Any]  # counters and settings of the run


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
    parameters: flat named arrays, `learning.served_parameters`.
    layout: the environment's layout.
    environment: the environment's name.
    settings: the agent's settings, `config.to_dict`.
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
    "layout": layout.to_dict(),
    "settings": dict(settings),
    "info": dict(info),
    "sha256": hashlib.sha256(data).hexdigest(),
  }
  replace_file(folder / _ARRAYS, data)
  replace_file(folder / _RECORD, json.dumps(record, indent=1).encode())


def load_policy(folder: Path | str) -> ExportedPolicy:
  """Loads a policy that `export_policy` wrote.

  Raises:
    ValueError: if the folder holds none, one of another format, or files that do not match.
  """
  record, parameters = _read(Path(folder))
  network = record["settings"]["network"]
  policy = Policy(parameters, init_stddev=network["init_stddev"], min_stddev=network["min_stddev"])
  return ExportedPolicy(
    policy=policy,
    layout=Layout.from_dict(record["layout"]),
    environment=record["environment"],
    history=record["settings"]["history"],
    info=record["info"],
  )


def load_arrays(folder: Path | str) -> dict[str, np.ndarray]:
  """Loads the flat named arrays of a policy; raises ValueError as `load_policy` does."""
  return _read(Path(folder))[1]


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
  if not (folder / _RECORD).exists():
    raise ValueError(f"{folder} holds no {_RECORD}: give the folder of an exported policy.")
  record = json.loads((folder / _RECORD).read_text())
  if record.get("format_version") != FORMAT_VERSION:
    raise ValueError(
      f"{folder} is of format {record.get('format_version')}, expected {FORMAT_VERSION}: export it "
      "again with this version."
    )
  data = (folder / _ARRAYS).read_bytes()
  if hashlib.sha256(data).hexdigest() != record["sha256"]:
    raise ValueError(f"{folder}: the arrays are not those of {_RECORD}; export it again.")
  with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
    return record, {name: arrays[name] for name in arrays.files}


def replace_file(path: Path, data: bytes) -> None:
  """Writes a file as a whole: another process sees the old content or the new."""
  temporary = path.with_name(f".{path.name}.{os.getpid()}")
  try:
    with temporary.open("wb") as stream:
      stream.write(data)
      stream.flush()
      os.fsync(stream.fileno())
    temporary.replace(path)
  finally:
    temporary.unlink(missing_ok=True)
