"""The real robot behind the specification of the simulation, and a virtual one for rehearsals.

`real.load("nerf_nav", robot=real.Connection(port="/dev/ttyUSB0", camera=0))` is to the robot what
`suite.load` is to the simulation.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
  from nerf2real.real.loading import Connection, load

__all__ = ["Connection", "load"]


def __getattr__(name: str) -> Any:
  # Loaded on first use: the recorder's process needs no environment.
  if name in __all__:
    from nerf2real.real import loading

    return getattr(loading, name)
  raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
