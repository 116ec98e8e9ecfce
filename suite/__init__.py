"""The simulated world: a robot with its sensors and tasks in a scene bundle.

`suite.load("nerf_nav")` returns a dm_control environment in the built-in room.
"""

import warnings

# Without MUJOCO_GL, dm_control tries GLFW when it is imported, which warns if there is no display.
# The simulation needs none.
warnings.filterwarnings("ignore", ".*DISPLAY environment variable is missing", module="glfw")

from nerf2real.suite.loading import ALL_TASKS, load  # noqa: E402  (the filter must come first)

__all__ = ["ALL_TASKS", "load"]
