"""Whole runs, as a person starts them: learner, actors and evaluator as processes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nerf2real.agents.dmpo.policy import acting
from nerf2real.agents.dmpo.policy.export import load_policy
from nerf2real.agents.environments import loading
from nerf2real.agents.processes.checkpoints import read_info

ROOT = Path(__file__).resolve().parents[3]
FILL = 200  # steps that fill the replay, and pay for no update
SMALL = [
  "--set",
  "network.policy_layers=[16,16]",
  "--set",
  "network.critic_layers=[16,16]",
  "--set",
  "batch_size=4",
  "--set",
  f"min_replay_steps={FILL}",
  "--set",
  "num_samples=4",
  "--evaluation-period",
  "300",
  "--evaluation-episodes",
  "1",
  "--log-period",
  "0.5",
]
CARTPOLE = ["--env", "dm_control:cartpole:swingup", "--preset", "state"]


_started: list[subprocess.Popen] = []


@pytest.fixture(autouse=True)
def _leave_nothing_running():
  yield
  for process in _started:
    if process.poll() is None:
      process.terminate()
      process.wait(timeout=90)
  _started.clear()


def start(run, *arguments):
  command = [sys.executable, ROOT / "launch/local_distributed.py", "--run", run, *arguments]
  process = subprocess.Popen(
    command,
    env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "120"},
    stdout=subprocess.PIPE,
    stderr=subprocess.STDOUT,
    text=True,
  )
  _started.append(process)
  return process


def finish(process, *, timeout, run):
  try:
    output, _ = process.communicate(timeout=timeout)
  except subprocess.TimeoutExpired:
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=30)
    logs = "\n".join(f"{p.name}: {p.read_text()[-2000:]}" for p in (run / "logs").iterdir())
    raise AssertionError(f"The run did not end.\n{output}\n{logs}") from None
  return output


def rows(run, source=""):
  path = run / "metrics.jsonl"
  lines = path.read_text().splitlines() if path.exists() else []
  return [r for r in map(json.loads, lines) if r["source"].startswith(source)]


def wait_until(condition, *, timeout=400.0):
  deadline = time.monotonic() + timeout
  while not condition():
    assert time.monotonic() < deadline, "It did not happen in time."
    time.sleep(0.1)


def children(process, script):
  """Process ids of a run's processes of one script."""
  found = []
  for folder in Path("/proc").iterdir():
    if not folder.name.isdigit():
      continue
    try:
      stat = (folder / "stat").read_text().rpartition(")")[2].split()
      if stat[1] == str(process.pid) and script in (folder / "cmdline").read_text():
        found.append(int(folder.name))
    except OSError:
      continue
  return sorted(found)


def test_a_run_ends_by_itself_and_is_resumed(tmp_path):
  """Exact counts, logs, checkpoint and policy; then the same counters go on, after Ctrl-C too."""
  run = tmp_path / "run"
  first = start(run, *CARTPOLE, *SMALL, "--actors", "2", "--max-env-steps", "600")
  output = finish(first, timeout=90, run=run)
  assert first.returncode == 0, output
  info = read_info(run)
  assert (info["steps"], info["updates"]) == (600, (600 - FILL) // 4)
  last = rows(run, "learner")[-1]
  assert last["dropped"] == last["refused"] == last["gaps"] == 0
  assert last["replay_steps"] == 600
  assert any("return" in r for r in rows(run, "evaluator"))
  assert list((run / "tensorboard").iterdir())
  exported = load_policy(run / "policy" / "newest")
  agent = acting.Agent(exported.policy, exported.layout, seed=0, deterministic=True)
  environment = loading.make_environment(exported.environment, seed=0)
  agent.act(exported.layout.flatten(environment.reset().observation))

  refused = start(run, *CARTPOLE, *SMALL)
  assert "add --resume" in finish(refused, timeout=60, run=run) and refused.returncode == 2

  second = start(run, *SMALL, "--actors", "1", "--resume", "--no-evaluator")
  wait_until(lambda: rows(run, "learner")[-1]["updates"] >= 150)
  second.send_signal(signal.SIGINT)
  output = finish(second, timeout=60, run=run)
  assert second.returncode == 0 and "writes a checkpoint" in output, output
  info = read_info(run)
  assert info["updates"] >= 150
  # Steps and updates go on where they were, and the replay has filled twice: the ratio holds.
  assert info["unpaid_steps"] == 2 * FILL
  assert 0 <= info["steps"] - 2 * FILL - 4 * info["updates"] <= 50
  assert children(second, "launch") == []


@pytest.mark.slow
def test_killed_processes_are_replaced(tmp_path):
  """kill -9 of an actor, then of the learner: the run ends with exact counts all the same."""
  run = tmp_path / "run"
  process = start(
    run,
    *CARTPOLE,
    *SMALL,
    "--actors",
    "2",
    "--max-env-steps",
    "3000",
    "--checkpoint-period",
    "1",
    "--replay-on-disk",
  )
  wait_until(lambda: len(rows(run, "learner")) > 1)
  os.kill(children(process, "actor.py")[0], signal.SIGKILL)
  wait_until(lambda: list((run / "checkpoints").glob("newest-*")))
  before = read_info(run)["updates"]
  os.kill(children(process, "learner.py")[0], signal.SIGKILL)
  output = finish(process, timeout=180, run=run)
  assert process.returncode == 0, output
  assert "2 restarts" in output
  info = read_info(run)
  assert before > 0 and (info["steps"], info["updates"]) == (3000, (3000 - FILL) // 4)
  assert rows(run, "learner")[-1]["dropped"] == 0


@pytest.mark.slow
def test_a_learner_frozen_for_20_seconds(tmp_path):
  """Longer than the lease: actors wait, and nothing is lost."""
  run = tmp_path / "run"
  process = start(run, *CARTPOLE, *SMALL, "--actors", "2", "--max-env-steps", "3000")
  wait_until(lambda: len(rows(run, "learner")) > 1)
  (learner,) = children(process, "learner.py")
  os.kill(learner, signal.SIGSTOP)
  time.sleep(20)
  os.kill(learner, signal.SIGCONT)
  output = finish(process, timeout=180, run=run)
  assert process.returncode == 0, output
  assert "0 restarts" in output
  info = read_info(run)
  assert (info["steps"], info["updates"]) == (3000, (3000 - FILL) // 4)
  last = rows(run, "learner")[-1]
  assert last["dropped"] == last["gaps"] == 0


@pytest.mark.slow
def test_pictures_lstm_state_and_belief_go_through(tmp_path):
  """The visual memory task over the whole path, for a few updates."""
  run = tmp_path / "run"
  process = start(
    run,
    "--env",
    "agents:cue",
    "--preset",
    "vision_small",
    *SMALL,
    "--actors",
    "1",
    "--max-env-steps",
    "1600",
  )
  output = finish(process, timeout=240, run=run)
  assert process.returncode == 0, output
  assert read_info(run)["updates"] == (1600 - FILL) / 8


def test_wrong_arguments_are_one_line(tmp_path):
  run = tmp_path / "run"
  process = start(run, "--env", "dm_control:cartpole:fly", "--actors", "1", "--no-evaluator")
  output = finish(process, timeout=60, run=run)
  assert process.returncode == 1 and "has no task 'cartpole:fly'" in output
  assert "Traceback" not in output
  assert not run.exists(), "a refused start leaves nothing"


def test_nothing_to_resume_is_refused_at_once(tmp_path):
  process = start(tmp_path / "run", "--resume", "--env", "dm_control:cartpole:swingup")
  output = finish(process, timeout=60, run=tmp_path / "run")
  assert process.returncode == 2 and "holds no checkpoint to go on from" in output
  assert output.count("\n") == 1 and not (tmp_path / "run").exists()
