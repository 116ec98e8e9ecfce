"""A folder that another process writes is refused by every command, in one line."""

import subprocess
import sys

import pytest

from tests.launch.test_identify import _log
from tests.sysid.synthetic import PENDULUM

_HOLD = """
import sys, time
from contextlib import ExitStack
from nerf2real.core.folder_lock import lock_folder
with ExitStack() as stack:
  for name in (".lock", ".learner.lock", ".loop.lock"):
    stack.enter_context(lock_folder(sys.argv[1], name=name))
  print("held", flush=True)
  time.sleep(600)
"""


@pytest.fixture(scope="module")
def held(tmp_path_factory):
  """A folder that another process writes, and that process."""
  folder = tmp_path_factory.mktemp("held")
  process = subprocess.Popen(
    [sys.executable, "-c", _HOLD, str(folder)], stdout=subprocess.PIPE, text=True
  )
  assert process.stdout.readline() == "held\n"
  yield folder, process
  process.kill()
  process.wait()
  process.stdout.close()


@pytest.mark.parametrize(
  ("script", "arguments", "status"),
  [
    ("make_scene", ("--capture", "builtin", "--out", "{}"), 1),
    ("local_distributed", ("--env", "agents:cue", "--run", "{}"), 2),
    ("distill", ("--preset", "tiny", "--run", "{}"), 2),
    ("learner", ("--env", "agents:cue", "--run", "{}"), 1),
    ("distill_learner", ("--preset", "tiny", "--run", "{}"), 1),
    ("evaluate", ("--trials", "1", "--out", "{}"), 1),
    ("identify", ("--model", "{model}", "--logs", "{log}", "--out", "{}"), 1),
    ("close_loop", ("--out", "{}"), 1),
  ],
)
def test_second_process_is_refused(run, held, tmp_path, monkeypatch, script, arguments, status):
  monkeypatch.setattr("nerf2real.launch.command._PATIENCE", 0.0)
  folder, process = held
  model = tmp_path / "model.xml"
  model.write_text(PENDULUM)
  log = _log(tmp_path / "log.mcap") if script == "identify" else ""
  before = sorted(folder.rglob("*"))
  ended = run(script, *(text.format(folder, model=model, log=log) for text in arguments))
  assert ended.status == status, ended
  (line,) = ended.err.splitlines()
  assert line.startswith(f"error: {folder} is being written by process {process.pid} on ")
  assert sorted(folder.rglob("*")) == before
