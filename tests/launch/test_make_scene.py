"""The command's errors are one clear line and leave nothing that looks like a bundle."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from nerf2real.launch.make_scene import Arguments, main, settings_of

_ROOT = Path(__file__).parents[2]


_ALL = """
import runpy, sys
captures = sys.argv[1:]
for capture, out in zip(captures[::2], captures[1::2]):
  sys.argv[1:] = ["--capture", capture, "--out", out]
  try:
    runpy.run_path("launch/make_scene.py", run_name="__main__")
  except SystemExit as end:
    print("ended with", end.code, file=sys.stderr, flush=True)
"""


def make(captures):
  """What each capture, with its folder for the scene, has the command write on stderr, and status.

  One process makes them one after another: most of its time goes into imports.
  """
  command = [sys.executable, "-c", _ALL, *(str(path) for pair in captures for path in pair)]
  done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, timeout=240)
  assert done.returncode == 0, done.stderr
  *found, rest = re.split(r"ended with (\d+)\n", done.stderr)
  assert not rest.strip()
  return list(zip(found[::2], map(int, found[1::2]), strict=True))


@pytest.fixture
def three_pictures(tmp_path):
  folder = tmp_path / "pictures"
  folder.mkdir()
  for number in range(3):
    picture = np.random.default_rng(number).integers(0, 255, (60, 80, 3), np.uint8)
    cv2.imwrite(str(folder / f"{number}.png"), picture)
  return folder


def test_bad_captures_are_one_clear_line(three_pictures, tmp_path):
  empty = tmp_path / "empty.mp4"
  empty.touch()
  damaged = tmp_path / "damaged.mp4"
  damaged.write_bytes(b"not a video" * 100)
  cases = (
    (tmp_path / "none.mp4", "does not exist"),
    (three_pictures, "3 pictures"),
    (empty, "empty"),
    (damaged, "damaged"),
  )
  outs = [tmp_path / f"out_{source.stem}" for source, _ in cases]
  ended = make([(source, out) for (source, _), out in zip(cases, outs, strict=True)])
  for (_, expected), out, (said, status) in zip(cases, outs, ended, strict=True):
    assert status == 1, said
    lines = [line for line in said.splitlines() if line.strip()]
    assert lines[-1].startswith("error: ") and expected in lines[-1], said
    assert "Traceback" not in said
    assert not (out / "scene.json").exists()
    assert not (out / "field.safetensors").exists()


def test_a_gpu_that_is_not_there_is_missed_before_anything_is_made(tmp_path, monkeypatch, capsys):
  monkeypatch.setattr("warp.is_cuda_available", lambda: False)
  words = ["--capture", "builtin", "--out", str(tmp_path / "out"), "--device", "cuda"]
  monkeypatch.setattr("sys.argv", ["make_scene.py", *words])
  assert main() == 1
  assert "No CUDA device was found" in capsys.readouterr().err
  assert not (tmp_path / "out").exists()
  arguments = Arguments(capture="builtin", out=tmp_path, device="cuda")
  assert settings_of(arguments).train.device == "cuda"


@pytest.mark.parametrize(("seconds", "expected"), [(None, None), (60.0, 60.0)])
def test_steps_stand_in_place_of_seconds(seconds, expected):
  arguments = Arguments(capture="x", out=Path("y"), train_steps=500, train_seconds=seconds)
  train = settings_of(arguments).train
  assert (train.max_steps, train.max_seconds) == (500, expected)
