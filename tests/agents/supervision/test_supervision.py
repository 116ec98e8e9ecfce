"""The supervisor's decisions with scripted processes, and what real ones say when they die."""

import dataclasses
import signal
import subprocess
import time
from pathlib import Path

import pytest

from nerf2real.agents.supervision import training
from nerf2real.agents.supervision.statuses import NOT_SAVED, REFUSED
from nerf2real.agents.supervision.supervisor import Job, LocalProcess, Supervisor
from tests.agents.processes.test_runs import CARTPOLE, SMALL, finish, rows, start, wait_until

LEARNER = Job(name="learner", script=Path("learner.py"), arguments=("--run", "x"))
ACTOR = Job(name="actor-0", script=Path("actor.py"), arguments=("--connect", "y"))


@dataclasses.dataclass
class Scripted:
  """A process whose exit status a test sets."""

  job: Job
  status: int | None = None
  ends_with: int = 0
  waiting: bool = False
  terminated: bool = False
  released: bool = False

  def exit_status(self):
    return self.status

  def last_words(self):
    return f"last words of {self.job.name}"

  def terminate(self, timeout):
    self.terminated = True

  def wait(self):
    self.status = self.ends_with
    return self.status

  def release(self):
    self.released = True


class Run:
  """A supervisor over scripted processes, in the order in which they were started."""

  def __init__(self, folder, *, resume=False, window=60.0):
    self.started: list[Scripted] = []
    self.supervisor = Supervisor(
      self._start,
      LEARNER,
      [ACTOR],
      checkpoints=folder,
      resume=resume,
      restart_window=window,
      end_timeout=1.0,
    )
    self.supervisor.start()

  def _start(self, job):
    self.started.append(Scripted(job))
    return self.started[-1]

  def die(self, index, status):
    self.started[index].status = status
    return self.supervisor.watch()


def test_what_died_is_started_again_and_a_learner_goes_on_from_its_checkpoint(tmp_path):
  run = Run(tmp_path)
  assert run.supervisor.watch() is None and len(run.started) == 2
  assert run.die(1, 1) is None
  assert run.started[2].job == ACTOR and run.started[1].released
  assert run.die(0, -signal.SIGKILL) is None
  assert run.started[3].job == LEARNER  # there is no checkpoint yet
  (tmp_path / "newest-0000000001-000000000008").mkdir()
  assert run.die(3, 1) is None
  assert run.started[4].job.arguments == ("--run", "x", "--resume")
  assert run.die(4, 1) is None
  assert run.started[5].job.arguments == ("--run", "x", "--resume")
  assert run.supervisor.restarts == 4


def test_what_a_save_that_was_cut_off_leaves_is_nothing_to_go_on_from(tmp_path):
  run = Run(tmp_path)
  (tmp_path / "newest-0000000000-000000000000.orbax-checkpoint-tmp").mkdir()
  assert run.die(0, -signal.SIGKILL) is None
  assert run.started[2].job == LEARNER


@pytest.mark.parametrize(("seed", "said"), [(None, ()), (5, ("--seed", "5"))])
def test_a_seed_is_said_to_the_learner_alone_and_where_one_was_given(seed, said):
  settings = training.TrainingSettings(run=Path("x"), resume=True, seed=seed)
  scripts = training.Scripts(learner=Path("learner.py"), actor=Path("actor.py"))
  learner, others = training.make_jobs(settings, scripts, learner=(), actor=(), forwarded=())
  assert learner.arguments == ("--run", "x", *said)
  assert not any("--seed" in job.arguments for job in others)


def test_the_first_start_resumes_where_that_was_said(tmp_path):
  assert Run(tmp_path, resume=True).started[0].job.arguments[-1] == "--resume"


def test_a_run_ends_regularly_with_its_learner(tmp_path):
  run = Run(tmp_path)
  assert run.die(1, 0) is None and len(run.started) == 2  # an actor that is done is not replaced
  assert run.die(0, 0) == ""
  assert run.supervisor.end() == ""
  assert not run.started[0].terminated


@pytest.mark.parametrize("status", [REFUSED, NOT_SAVED])
@pytest.mark.parametrize("index", [0, 1])
def test_no_restart_where_it_would_not_help(index, status, tmp_path):
  run = Run(tmp_path)
  name = ("Learner", "Actor-0")[index]
  reason = run.die(index, status)
  assert reason.startswith(f"{name} ended with status {status} (")
  assert reason.endswith(f":\nlast words of {name.lower()}")
  assert run.supervisor.restarts == 0


def test_a_refusal_is_said_in_one_line_without_what_libraries_logged(tmp_path):
  run = Run(tmp_path)
  run.started[0].last_words = lambda: (
    "21:00 learner: No module named 'X'\nerror: room has no scene.json: make it.\nlearner: closed"
  )
  assert run.die(0, REFUSED) == (
    f"Learner ended with status {REFUSED} (it cannot start with its arguments): "
    "room has no scene.json: make it."
  )


def test_more_than_five_restarts_within_the_window_end_the_run(tmp_path):
  run = Run(tmp_path)
  for restart in range(5):
    assert run.die(-1 if restart else 1, 7) is None
  assert run.die(-1, 7) == "Actor-0 ended with status 7:\nlast words of actor-0"


def test_old_restarts_are_forgotten(tmp_path):
  run = Run(tmp_path, window=0.02)
  for restart in range(8):
    time.sleep(0.01)
    assert run.die(-1 if restart else 1, 7) is None


@pytest.mark.parametrize(
  ("status", "said"),
  [
    (0, ""),
    (-signal.SIGTERM, ""),  # ended while it was starting
    (NOT_SAVED, "Learner ended with status 3 (what it learned last is not saved"),
    (-signal.SIGKILL, "Learner ended with status -9 (killed)"),
  ],
)
def test_a_learner_that_does_not_save_at_the_end_is_reported(status, said, tmp_path):
  run = Run(tmp_path)
  run.started[0].ends_with = status
  found = run.supervisor.end()
  assert found.startswith(said) if said else found == ""
  assert all(process.terminated and process.released for process in run.started)


def test_a_process_that_ignores_sigterm_is_killed_and_its_words_are_kept(tmp_path):
  script = tmp_path / "stubborn.py"
  script.write_text(
    "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
    "print('deaf', flush=True)\ntime.sleep(60)\n"
  )
  process = LocalProcess(script, (), log=tmp_path / "log")
  wait_until(lambda: process.last_words() == "deaf", timeout=60)
  assert process.exit_status() is None
  process.terminate(0.2)
  assert process.wait() == -signal.SIGKILL == process.exit_status()


def test_a_full_disk_at_the_end_is_no_success(tmp_path):
  """Updates that are lost because the last checkpoint does not fit are said, with a status."""
  disk = tmp_path / "disk"
  disk.mkdir()
  try:
    subprocess.run(
      ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", disk], check=True, capture_output=True
    )
  except (OSError, subprocess.CalledProcessError):
    pytest.skip("needs the right to mount a small disk")
  run = disk / "run"
  try:
    process = start(
      run, *CARTPOLE, *SMALL, "--actors", "1", "--no-evaluator", "--max-env-steps", "2000"
    )
    wait_until(lambda: rows(run, "learner"))
    with pytest.raises(OSError, match="No space"), (disk / "fill").open("wb", buffering=0) as fill:
      while fill.write(bytes(4096)):
        pass
    output = finish(process, timeout=90, run=run)
  finally:
    subprocess.run(["umount", "-l", disk], check=True)
  assert process.returncode == 1, output
  assert "error: Learner ended with status 3 (what it learned last is not saved" in output
  assert "The run is in" not in output


def test_last_words_reach_the_console(tmp_path):
  (tmp_path / "run").mkdir()
  (tmp_path / "run" / "metrics.jsonl").mkdir()  # where the learner wants to write
  process = start(tmp_path / "run", *CARTPOLE, *SMALL, "--actors", "1", "--no-evaluator")
  output = finish(process, timeout=120, run=tmp_path / "run")
  assert process.returncode == 1
  assert "Learner ended with status 2 (it cannot start with its arguments)" in output
  assert "Is a directory" in output and "Traceback" not in output
