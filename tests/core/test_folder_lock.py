"""One writer a folder: the second is refused, stale locks are taken over, nothing is left."""

import errno
import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from nerf2real.core import folder_lock
from nerf2real.core.folder_lock import (
  FILE,
  FolderInUseError,
  discarded_on,
  lock_folder,
  owner_of,
)

_HOLD = """
import sys, time
from nerf2real.core.folder_lock import lock_folder
with lock_folder(sys.argv[1]):
  print("held", flush=True)
  time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
  """Another process that holds the lock of tmp_path / "out"."""
  process = subprocess.Popen(
    [sys.executable, "-c", _HOLD, str(tmp_path / "out")], stdout=subprocess.PIPE, text=True
  )
  assert process.stdout.readline() == "held\n"
  yield process
  process.kill()
  process.wait()
  process.stdout.close()


def test_second_process_is_refused_and_named(tmp_path, holder):
  with pytest.raises(FolderInUseError) as caught, lock_folder(tmp_path / "out"):
    pass
  message = str(caught.value)
  assert str(holder.pid) in message and socket.gethostname() in message
  assert "\n" not in message
  assert owner_of(tmp_path / "out")["pid"] == holder.pid


def test_lock_of_a_killed_process_is_taken_over(tmp_path, holder):
  holder.send_signal(signal.SIGKILL)
  holder.wait()
  assert owner_of(tmp_path / "out")["pid"] == holder.pid, "the file itself stays"
  with lock_folder(tmp_path / "out"):
    assert owner_of(tmp_path / "out")["pid"] == os.getpid()


def test_same_process_cannot_lock_twice_but_again(tmp_path):
  with lock_folder(tmp_path):
    with pytest.raises(FolderInUseError), lock_folder(tmp_path):
      pass
    with lock_folder(tmp_path, name=".other"):
      pass
    assert owner_of(tmp_path)["pid"] == os.getpid()
  with lock_folder(tmp_path):
    pass


def test_nothing_is_left_of_a_command_that_wrote_nothing(tmp_path):
  with pytest.raises(ZeroDivisionError), lock_folder(tmp_path / "a" / "b"):
    raise ZeroDivisionError
  assert not (tmp_path / "a").exists() and tmp_path.exists()


def test_what_was_written_is_kept_without_the_lock(tmp_path):
  with lock_folder(tmp_path / "a" / "b"):
    (tmp_path / "a" / "b" / "result").write_text("1")
  assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["result"]


def test_lock_that_was_removed_while_waiting_is_taken_anew(tmp_path, monkeypatch):
  """Opened, then removed by its owner, then locked: that file excludes nobody."""
  lock, removed = fcntl.flock, []

  def flock(descriptor, operation):
    if not removed:
      removed.append(True)
      (tmp_path / FILE).unlink()
    lock(descriptor, operation)

  monkeypatch.setattr(fcntl, "flock", flock)
  with lock_folder(tmp_path):
    monkeypatch.undo()
    with pytest.raises(FolderInUseError), lock_folder(tmp_path):
      pass


@pytest.mark.parametrize(
  ("owner", "free"),
  [
    ({"pid": os.getpid(), "host": socket.gethostname()}, False),
    ({"pid": 2**22 + 1, "host": socket.gethostname()}, True),  # above Linux's largest pid
    ({"pid": 1, "host": "elsewhere"}, False),
  ],
)
def test_without_flock_the_owner_decides(tmp_path, monkeypatch, owner, free):
  def flock(descriptor, operation):
    raise OSError(errno.ENOLCK, "no locks available")

  monkeypatch.setattr(fcntl, "flock", flock)
  (tmp_path / FILE).write_text(json.dumps(owner | {"time": time.time()}))
  if free:
    with lock_folder(tmp_path):
      assert folder_lock.owner_of(tmp_path)["pid"] == os.getpid()
  else:
    with pytest.raises(FolderInUseError), lock_folder(tmp_path):
      pass


def test_folder_that_cannot_be_made_is_said(tmp_path):
  (tmp_path / "file").write_text("")
  with pytest.raises(OSError, match="is a file, expected a folder"), lock_folder(tmp_path / "file"):
    pass


def test_patience_waits_for_the_lock(tmp_path, holder):
  threading.Timer(0.3, holder.kill).start()
  with lock_folder(tmp_path / "out", patience=30.0):
    assert owner_of(tmp_path / "out")["pid"] == os.getpid()


def test_a_refused_start_leaves_nothing_and_an_old_folder_alone(tmp_path):
  for folder, there in ((tmp_path / "new", False), (tmp_path, True)):
    with pytest.raises(KeyError), discarded_on(KeyError, folder), lock_folder(folder):
      (folder / "half").write_text("")
      raise KeyError
    assert folder.exists() == there
  with pytest.raises(ValueError), discarded_on(KeyError, tmp_path / "new"):
    (tmp_path / "new").mkdir()
    raise ValueError
  assert (tmp_path / "new").exists(), "another error: what was made stays"
