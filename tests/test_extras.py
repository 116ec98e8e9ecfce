"""Each role's machine gets what it needs and no more: installs in bare environments, from PyPI."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
_INSTALLED = (
  "import importlib.metadata as m, json; print(json.dumps([d.name for d in m.distributions()]))"
)
_ROBOT = """
import nerf2real.real.check, nerf2real.real.recorder.recorder, nerf2real.real.camera.device
import nerf2real.launch.check_robot, nerf2real.launch.calibrate_camera, nerf2real.launch.replay_log
from nerf2real import real
try:
  real.load("nerf_nav", robot="/dev/none", image_size=None)
except real.wire.port.PortError as error:
  print("no port", error)
"""
_ACTOR = """
import nerf2real.launch.actor, nerf2real.agents.processes.actor
from nerf2real.agents.environments.loading import make_environment
environment = make_environment("suite:nerf_nav", seed=0)
print(environment.reset().observation["camera"].shape)
"""


def _run(*command, cwd):
  environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
  done = subprocess.run(
    [str(part) for part in command],
    cwd=cwd,
    env=environment | {"PIP_DISABLE_PIP_VERSION_CHECK": "1", "MUJOCO_GL": "disabled"},
    capture_output=True,
    text=True,
    timeout=1800,
  )
  assert done.returncode == 0, done.stdout + done.stderr
  return done.stdout.strip()


@pytest.mark.parametrize(
  ("extra", "absent", "program", "words"),
  [
    ("", ("jax", "jaxlib", "warp-lang", "pycolmap", "coacd", "mujoco"), _ROBOT, "no port"),
    ("[actor]", ("pycolmap", "orbax-checkpoint", "optax", "coacd"), _ACTOR, "(30, 40, 3)"),
  ],
)
def test_a_bare_environment(extra, absent, program, words, tmp_path):
  _run(sys.executable, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
  python = tmp_path / "venv" / "bin" / "python"
  _run(python, "-m", "pip", "install", "--quiet", f"{ROOT}{extra}", cwd=tmp_path)
  names = {
    name.lower().replace("_", "-")
    for name in json.loads(_run(python, "-c", _INSTALLED, cwd=tmp_path))
  }
  assert not names & set(absent)
  assert words in _run(python, "-c", program, cwd=tmp_path)
