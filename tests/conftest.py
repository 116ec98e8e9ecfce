"""Set-up of all tests: MuJoCo draws through EGL where there is no screen, as on a server."""

import os

if "DISPLAY" not in os.environ:
  os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported, so before anything else
