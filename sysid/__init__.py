"""Measured logs: residual, missing effect, extended model, report."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
  from nerf2real.sysid.drift.later import check_drift, evaluate
  from nerf2real.sysid.outputs.identify import identify
  from nerf2real.sysid.settings import Settings

__all__ = ["Settings", "check_drift", "evaluate", "identify"]

_HOMES = {
  "Settings": "nerf2real.sysid.settings",
  "check_drift": "nerf2real.sysid.drift.later",
  "evaluate": "nerf2real.sysid.drift.later",
  "identify": "nerf2real.sysid.outputs.identify",
}


def __getattr__(name: str) -> Any:
  # Loaded when asked for: who writes or reads a log needs no solver.
  if name in _HOMES:
    return getattr(importlib.import_module(_HOMES[name]), name)
  raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
