"""A robot's host imports no simulator's composer, no learning library and no reconstruction."""

import json
import subprocess
import sys
from pathlib import Path

_ROOT = Path(__file__).parents[2]
_HEAVY = ("dm_control.composer", "mujoco", "jax", "warp", "pycolmap", "coacd", "numba")
# What `launch/check_robot.py --robot /dev/ttyUSB0 --camera 0 --record x.mcap` imports, up to the
# port, which is not there.
_PROGRAM = """
import json, sys
found = {}
def note(when):
  found[when] = [name for name in sys.argv[1].split() if name in sys.modules]
import nerf2real.real
import nerf2real.suite
note("packages")
import nerf2real.real.loading
from nerf2real.real.camera.device import Camera
from nerf2real.real.recorder.recorder import Recorder
note("real")
import nerf2real.real.check
from nerf2real.launch import check_robot
note("check_robot")
for task in nerf2real.suite.ALL_TASKS:
  try:
    nerf2real.real.load(task, robot="/dev/none", image_size=None)
    found["error"] = "opened"
  except nerf2real.real.wire.port.PortError:
    pass
note("load")
print(json.dumps(found))
"""


def test_a_robots_host_imports_nothing_heavy():
  done = subprocess.run(
    [sys.executable, "-c", _PROGRAM, " ".join(_HEAVY)],
    cwd=_ROOT,
    capture_output=True,
    text=True,
    timeout=120,
  )
  assert done.returncode == 0, done.stderr
  assert json.loads(done.stdout) == {"packages": [], "real": [], "check_robot": [], "load": []}
