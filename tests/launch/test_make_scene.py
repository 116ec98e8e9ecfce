"""The command's errors are one clear line and leave nothing that looks like a bundle."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from nerf2real.launch.make_scene import Arguments, settings_of

_ROOT = Path(__file__).parents[2]


def run(*arguments):
  command = [sys.executable, "launch/make_scene.py", *map(str, arguments)]
  return subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, timeout=120)


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
  for source, expected in (
    (tmp_path / "none.mp4", "does not exist"),
    (three_pictures, "3 pictures"),
    (empty, "empty"),
    (damaged, "damaged"),
  ):
    out = tmp_path / f"out_{source.stem}"
    done = run("--capture", source, "--out", out)
    assert done.returncode == 1, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert lines[-1].startswith("error: ") and expected in lines[-1], done.stderr
    assert "Traceback" not in done.stderr
    assert not (out / "scene.json").exists()
    assert not (out / "field.safetensors").exists()


@pytest.mark.parametrize(("seconds", "expected"), [(None, None), (60.0, 60.0)])
def test_steps_stand_in_place_of_seconds(seconds, expected):
  arguments = Arguments(capture="x", out=Path("y"), train_steps=500, train_seconds=seconds)
  train = settings_of(arguments).train
  assert (train.max_steps, train.max_seconds) == (500, expected)
