"""The real robot behind the specification of the simulation, and a virtual one for rehearsals.

`real.load("nerf_nav", robot="/dev/ttyUSB0", camera=0)` is to the robot what `suite.load` is to the
simulation.
"""

from typing import Any

__all__ = ["load"]


def __getattr__(name: str) -> Any:
  # Loaded when asked for: the virtual room and the recorder's process need no environment.
  if name == "load":
    from nerf2real.real.loading import load

    return load
  raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
