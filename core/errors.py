"""Messages for bad input: what was found, what was expected, what to do."""

import os
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from dm_env import specs


def unknown_name(kind: str, found: Any, known: Iterable[str]) -> str:
  """Returns the message for a name that does not exist."""
  return f"Unknown {kind} {found!r}: expected one of {', '.join(repr(name) for name in known)}."


def first_few(names: Sequence[str], most: int) -> str:
  """Returns up to `most` names: "a, b and 3 more"."""
  rest = f" and {len(names) - most} more" if len(names) > most else ""
  return ", ".join(names[:most]) + rest


def not_compiled(error: ValueError, scene: Any) -> str:
  """Returns the message for a model that cannot be built; MuJoCo's own words name the element."""
  if "Compile error" not in str(error):
    return str(error)
  reason = [line for line in str(error).splitlines() if line.startswith(("Error", "Element"))]
  return f"MuJoCo cannot build {scene} ({'; '.join(reason)}): make the scene's bundle again."


def no_opengl(error: Exception) -> str:
  """Returns the message where MuJoCo cannot draw; its backends fail with traces of their own."""
  chosen = os.environ.get("MUJOCO_GL", "not set")
  reason = " ".join(str(error).split()) or type(error).__name__
  return (
    f"MuJoCo cannot draw here (MUJOCO_GL is {chosen}: {reason}): set MUJOCO_GL=egl (package "
    "libegl1) or MUJOCO_GL=osmesa (package libosmesa6) before the program starts."
  )


def bad_action(action: np.ndarray, spec: specs.BoundedArray) -> str:
  """Returns the message for an action that cannot be applied."""
  if action.shape != spec.shape:
    return (
      f"An action has shape {spec.shape}, one entry for each joint in the order of "
      f"suite.op3.constants.JOINT_NAMES; found shape {action.shape}."
    )
  return f"An action must be finite, found {np.count_nonzero(~np.isfinite(action))} bad entries."
