"""Ctrl-C and SIGTERM end commands without traces, leaving what is whole."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import pytest

from nerf2real.launch import command

ROOT = Path(__file__).resolve().parents[2]


def _start(script, *arguments):
  return subprocess.Popen(
    [sys.executable, ROOT / "launch" / f"{script}.py", *map(str, arguments)],
    env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
  )


def _end(process, number):
  process.send_signal(number)
  out, err = process.communicate(timeout=120)
  for trace in ("Traceback", "Exception", "terminate called", "*** "):  # Python's, C++'s, glog's
    assert trace not in err, err
  return out, err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_virtual_robot_frees_its_camera(number):
  process = _start("virtual_robot", "--world", "floor")
  assert process.stdout.readline().startswith("port: ")
  url = process.stdout.readline().split()[1]
  subprocess.run(  # until the first picture, when the renderer is there
    [sys.executable, "-c", f"import cv2; assert cv2.VideoCapture({url!r}).read()[0]"], check=True
  )
  _, err = _end(process, number)
  assert process.returncode == 0 and err == ""


def test_an_interrupted_rollout_leaves_a_video_that_plays(tmp_path):
  video = tmp_path / "out.mp4"
  process = _start("rollout", "--seconds", "600", "--video", video)
  deadline = time.monotonic() + 300.0
  while not any(path.stat().st_size > 10_000 for path in tmp_path.iterdir()):  # some frames
    assert time.monotonic() < deadline and process.poll() is None
    time.sleep(0.2)
  _, err = _end(process, signal.SIGINT)
  assert process.returncode == 128 + signal.SIGINT and err.splitlines()[-1] == "interrupted"
  with av.open(str(video)) as container:
    assert sum(1 for _ in container.decode(video=0)) >= 1
  assert [path.name for path in tmp_path.iterdir()] == ["out.mp4"]


@pytest.mark.parametrize("ignored", [False, True])
def test_what_is_open_is_closed_when_the_terminal_goes(ignored):
  """A robot would stay under torque; where `nohup` has the signal ignored, it stays so."""
  before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
  received: list[signal.Signals] = []
  try:
    with contextlib.suppress(KeyboardInterrupt), command._terminated_as_interrupted(received):
      signal.raise_signal(signal.SIGHUP)
    assert received == ([] if ignored else [signal.SIGHUP])
    assert signal.getsignal(signal.SIGHUP) == (signal.SIG_IGN if ignored else signal.SIG_DFL)
  finally:
    signal.signal(signal.SIGHUP, before)


def test_a_signal_that_comes_in_a_destructor_is_not_lost():
  """Python drops what a destructor raises."""

  class Signals:
    def __del__(self):
      signal.raise_signal(signal.SIGTERM)

  received: list[signal.Signals] = []
  with pytest.raises(KeyboardInterrupt), command._terminated_as_interrupted(received):
    thing = Signals()
    del thing
    assert received == [signal.SIGTERM]
    time.sleep(10.0)
  assert received == [signal.SIGTERM]


@pytest.mark.slow
@pytest.mark.parametrize(
  ("script", "arguments", "ready"),
  [
    ("view", ("--port", "0"), "open http"),
    ("view", ("--task", "nerf_nav", "--port", "0"), "open http"),
    ("evaluate", ("--out", "{}", "--policy", "walker"), " 1/54"),
    ("router", ("--listen", "tcp/127.0.0.1:0"), "Routing"),
  ],
)
def test_others(tmp_path, script, arguments, ready):
  process = _start(script, *(text.format(tmp_path / "out") for text in arguments))
  assert any(ready in line for line in process.stdout)
  _end(process, signal.SIGTERM)
  assert process.returncode in (0, 128 + signal.SIGTERM)
  if script == "evaluate":
    assert {"episodes.jsonl", "report.html"} == {p.name for p in (tmp_path / "out").iterdir()}
