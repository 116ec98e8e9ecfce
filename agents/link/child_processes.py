"""Processes that end with the one that started them."""

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def start_child(command: list[str], *, log: Path) -> subprocess.Popen:
  """Starts a process whose output is appended to a file.

  Ctrl-C does not reach it: the parent ends its children in order. Where the parent is killed, Linux
  sends it SIGTERM.
  """
  with log.open("ab") as stream:
    return subprocess.Popen(
      command,
      stdout=stream,
      stderr=stream,
      stdin=subprocess.DEVNULL,
      env=os.environ | {"PYTHONUNBUFFERED": "1"},
      start_new_session=True,
      preexec_fn=_die_with_parent,
    )


def last_lines(log: Path, count: int = 8) -> str:
  """The end of a log; empty if there is none."""
  lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
  return "\n".join(lines[-count:])


def _die_with_parent() -> None:
  if sys.platform == "linux":
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
