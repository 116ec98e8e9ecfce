"""The examples run, and do what they say."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
  ("name", "arguments", "words"),
  [
    ("any_robot", ("--seconds", "0.5", "--out", "{}/seen.png"), "160 x 120"),
    ("own_task", (), "known: nerf_nav, ball_push, face_goal"),
    ("plain_mujoco", (), "the ball lies at a height of 0.1"),
    ("render_room", ("--out", "{}/drawn.png"), "drawn.png"),
    ("gymnasium_env", (), "camera (30, 40, 3)"),
    ("watch_policy", ("--seconds", "0.2", "--out", "{}/walk.mp4"), "walk.mp4"),
    pytest.param("identify_log", (), "truth: coulomb_friction at joint", marks=pytest.mark.slow),
  ],
)
def test_example(name, arguments, words, tmp_path):
  if name == "gymnasium_env":
    pytest.importorskip("gymnasium")
  done = subprocess.run(
    [sys.executable, ROOT / "examples" / f"{name}.py", *(a.format(tmp_path) for a in arguments)],
    cwd=tmp_path,
    env=os.environ | {"PYTHONPATH": str(ROOT)},
    capture_output=True,
    text=True,
    timeout=900,
  )
  assert done.returncode == 0, done.stderr
  assert words in done.stdout, done.stdout


def test_every_example_is_run_and_listed():
  names = {path.stem for path in (ROOT / "examples").glob("*.py")}
  listed = (ROOT / "examples" / "README.md").read_text()
  assert all(f"examples/{name}.py" in listed for name in names)
  source = Path(__file__).read_text()
  assert all(f'"{name}"' in source for name in names)
