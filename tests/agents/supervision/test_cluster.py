"""The same processes placed by Ray, on a cluster of this machine alone."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from nerf2real.agents.processes.checkpoints import read_info
from tests.agents.processes.test_runs import CARTPOLE, FILL, ROOT, SMALL, rows, wait_until


def _processes(script, run):
  """(process id, parent) of processes of a script that belong to a run or its router's port."""
  found = []
  for folder in Path("/proc").iterdir():
    if not folder.name.isdigit():
      continue
    try:
      command = (folder / "cmdline").read_text().split("\0")
      parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    except (OSError, IndexError):
      continue
    if any(part.endswith(f"launch/{script}") for part in command) and run in command:
      found.append((int(folder.name), parent))
  return found


@pytest.mark.slow
def test_ray_places_processes_again_when_their_machine_is_lost(tmp_path):
  """kill -9 of the Ray process that holds an actor, then of the learner: exact counts."""
  pytest.importorskip("ray", reason="needs Ray: pip install '.[cluster]'")
  run = tmp_path / "run"
  process = subprocess.Popen(
    [
      sys.executable,
      ROOT / "launch/cluster.py",
      "--address",
      "local",
      "--run",
      run,
      *CARTPOLE,
      *SMALL,
      "--actors",
      "1",
      "--actor-cpus",
      "0.3",
      "--learner-cpus",
      "0.5",
      "--max-env-steps",
      "3000",
      "--checkpoint-period",
      "1",
      "--replay-on-disk",
    ],
    env=os.environ | {"PYTHONPATH": str(ROOT)},
    stdout=subprocess.PIPE,
    stderr=subprocess.STDOUT,
    text=True,
  )
  try:
    wait_until(lambda: len(rows(run, "learner")) > 1, timeout=120)
    endpoint = next(
      part
      for part in Path(f"/proc/{_processes('learner.py', str(run))[0][0]}/cmdline")
      .read_text()
      .split("\0")
      if part.startswith("tcp/")
    )
    actor, ray_process = next(
      (pid, parent)
      for pid, parent in _processes("actor.py", endpoint)
      if "--evaluate" not in Path(f"/proc/{pid}/cmdline").read_text()
    )
    os.kill(ray_process, signal.SIGKILL)
    wait_until(lambda: actor not in [pid for pid, _ in _processes("actor.py", endpoint)])
    os.kill(_processes("learner.py", str(run))[0][0], signal.SIGKILL)
    output, _ = process.communicate(timeout=240)
  finally:
    if process.poll() is None:
      process.terminate()
      process.wait(timeout=120)
  assert process.returncode == 0, output
  assert "actor-0: lost" in output and "2 restarts" in output, output
  info = read_info(run)
  assert (info["steps"], info["updates"]) == (3000, (3000 - FILL) // 4)
  assert rows(run, "learner")[-1]["dropped"] == 0
  assert _processes("actor.py", endpoint) == _processes("learner.py", str(run)) == []
