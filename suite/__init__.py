"""The simulated world: a robot with its sensors and tasks in a scene bundle.

`suite.load("nerf_nav")` returns a dm_control environment in the built-in room. The simulator is
imported when `load` is: constants, specifications and filters are for a robot's host, too.
"""

import warnings
from typing import TYPE_CHECKING, Any

from nerf2real.suite.registry import known_tasks, register_task
from nerf2real.suite.tasks.catalogue import ALL_TASKS

if TYPE_CHECKING:
  from nerf2real.suite.loading import load

__all__ = ["ALL_TASKS", "known_tasks", "load", "register_task"]

# Without MUJOCO_GL, dm_control tries GLFW when it is imported, which warns if there is no display.
# The simulation needs none.
warnings.filterwarnings("ignore", ".*DISPLAY environment variable is missing", module="glfw")


def __getattr__(name: str) -> Any:
  if name == "load":
    from nerf2real.suite.loading import load

    return load
  raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
