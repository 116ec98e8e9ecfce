"""pycolmap leaves SIGTERM to Python."""

import subprocess
import sys

_PROGRAM = """
import os, signal, time
{before}
from nerf2real.scenes.colmap import pycolmap
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(10)
"""


def _terminated(before):
  return subprocess.run(
    [sys.executable, "-c", _PROGRAM.format(before=before)],
    capture_output=True,
    text=True,
    timeout=120,
  )


def test_the_handler_of_sigterm_stays():
  ended = _terminated("signal.signal(signal.SIGTERM, lambda *_: os._exit(7))")
  assert (ended.returncode, ended.stderr) == (7, "")


def test_without_a_handler_sigterm_ends_without_a_trace():
  ended = _terminated("")
  assert (ended.returncode, ended.stderr) == (-15, "")
