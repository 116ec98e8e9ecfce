"""Measured logs: residual, missing effect, extended model, report."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
  from sysid.identification import Settings
  from sysid.outputs import evaluate, identify

__all__ = ["Settings", "evaluate", "identify"]

_HOMES = {
  "Settings": "sysid.identification", "evaluate": "sysid.outputs", "identify": "sysid.outputs",
}  # fmt: skip


def __getattr__(name: str) -> Any:
  # Loaded when asked for: who writes or reads a log needs no solver.
  if name in _HOMES:
    return getattr(importlib.import_module(_HOMES[name]), name)
  raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
