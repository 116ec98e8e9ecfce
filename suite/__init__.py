"""The simulated world: a robot with its sensors and tasks in a scene bundle.

`suite.load("nerf_nav")` returns a dm_control environment in the built-in room.
"""

from suite.loading import ALL_TASKS, load

__all__ = ["ALL_TASKS", "load"]
