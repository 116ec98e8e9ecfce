"""The console command, and what all commands share: help, errors, exit statuses, signals."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nerf2real.launch import console

ROOT = Path(__file__).parents[2]
_ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100"}
CONSOLE = (sys.executable, "-m", "nerf2real.launch.console")


def _run(*command, **options):
  return subprocess.run(
    [str(part) for part in command],
    **{"cwd": ROOT, "env": _ENVIRONMENT, "capture_output": True, "text": True, "timeout": 120}
    | options,
  )


def test_help_lists_every_command_with_a_line_and_loads_no_library():
  heavy = ["numpy", "jax", "mujoco", "tyro", "zenoh", "rich"]
  code = (
    "import sys; sys.argv = ['nerf2real', '--help']; from nerf2real.launch import console; "
    f"console.main(); sys.exit(any(name in sys.modules for name in {heavy}))"
  )
  found = _run(sys.executable, "-c", code)
  assert found.returncode == 0, found.stdout + found.stderr
  lines = found.stdout.splitlines()
  assert lines[0].startswith("usage: nerf2real")
  for name in console.SCRIPTS:
    (line,) = (line for line in lines if line.split()[:1] == [name])
    assert len(line.split()) > 4 and line.endswith(".") and len(line) <= 120


def test_no_script_loads_numpy_before_it_has_set_its_threads():
  limited = [p.stem for p in (ROOT / "launch").glob("*.py") if "ONE_THREAD" in p.read_text()]
  assert len(limited) > 5
  code = (
    "import importlib, sys\nfor name in sys.argv[1:]:\n"
    "  importlib.import_module(f'nerf2real.launch.{name}')\n"
    "  if 'numpy' in sys.modules: sys.exit(name)"
  )
  found = _run(sys.executable, "-c", code, *limited)
  assert found.returncode == 0, f"{found.stderr.strip()} imports NumPy: too late for OpenBLAS"


def test_every_script_has_a_command():
  helpers = {"__init__", "command", "console"}
  assert {path.stem for path in (ROOT / "launch").glob("*.py")} - helpers == set(
    console.SCRIPTS.values()
  )


@pytest.mark.parametrize("name", console.SCRIPTS)
def test_help_is_that_of_the_script(name):
  script = f"launch/{console.SCRIPTS[name]}.py"
  mine, own = _run(*CONSOLE, name, "--help"), _run(sys.executable, script, "--help")
  assert mine.returncode == own.returncode == 0, mine.stderr + own.stderr
  assert mine.stdout == own.stdout.replace(f"usage: {script}", f"usage: nerf2real {name}", 1)
  fields = re.findall(r"^│ (--[a-z-]+)", own.stdout, re.MULTILINE)
  assert fields and own.stdout.startswith(f"usage: {script} [-h]")
  assert console.summary(console.SCRIPTS[name]) in " ".join(own.stdout.split())


def test_unknown_commands_and_options_have_status_2():
  found = _run(*CONSOLE, "evalate")
  assert found.returncode == 2 and "did you mean 'evaluate'?" in found.stderr
  assert _run(*CONSOLE).returncode == 2
  found = _run(*CONSOLE, "identify", "--modl", "x")
  assert found.returncode == 2 and "--modl" in found.stderr and "Traceback" not in found.stderr


def test_a_wrong_input_is_one_line_with_status_1(tmp_path):
  found = _run(*CONSOLE, "log", tmp_path / "none.mcap")
  assert found.returncode == 1
  assert found.stderr.startswith("error: ") and found.stderr.count("\n") == 1


def test_a_reader_that_has_seen_enough_is_no_error():
  command = " ".join([*CONSOLE, "film", "--help"])
  found = _run("bash", "-o", "pipefail", "-c", f"{command} | head -n 1")
  assert found.returncode in (0, 128 + signal.SIGPIPE) and found.stderr == ""


SCRIPT = '''"""A command."""
import dataclasses, sys, time, warnings
from nerf2real.launch import command

@dataclasses.dataclass(frozen=True)
class Arguments:
  """Arguments."""
  kind: str
  """What happens."""

def run(arguments):
  import os
  if arguments.kind == "trace":
    raise TypeError("of the programmer")
  if arguments.kind == "wrong":
    raise command.CommandError("cannot be together", status=command.WRONG_ARGUMENTS)
  if arguments.kind == "warning":
    warnings.warn("film the floor too", stacklevel=2)
    return 0
  if arguments.kind == "environment":
    print(os.environ["A_TEST"], os.environ["SET_BEFORE"])
    return 5
  if arguments.kind == "import":
    try:
      import imported_on_trial
      time.sleep(60)
    finally:
      time.sleep(0.3)  # to close what is open; nothing interrupts this
      print("closed", flush=True)
  try:
    print("ready", flush=True)
    time.sleep(60)
  finally:
    print("closed", flush=True)

sys.exit(command.main(Arguments, run, environment={"A_TEST": "1", "SET_BEFORE": "no"},
                      interrupted="stopped: go on with the same command"))
'''


@pytest.fixture
def script(tmp_path):
  path = tmp_path / "script.py"
  path.write_text(SCRIPT)
  return path


def test_the_programmers_errors_show_their_trace(script):
  found = _run(sys.executable, script, "--kind", "trace")
  assert (
    found.returncode == 1 and "Traceback" in found.stderr and "of the programmer" in found.stderr
  )


def test_a_warning_is_a_line_without_its_place_in_the_source(script):
  found = _run(sys.executable, script, "--kind", "warning")
  assert (found.returncode, found.stderr) == (0, "warning: film the floor too\n")


def test_environment_and_statuses(script):
  found = _run(sys.executable, script, "--kind", "wrong")
  assert (found.returncode, found.stderr) == (2, "error: cannot be together\n")
  environment = _ENVIRONMENT | {"SET_BEFORE": "yes"}
  found = _run(sys.executable, script, "--kind", "environment", env=environment)
  assert (found.returncode, found.stdout) == (5, "1 yes\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_in_one_line_and_close_what_is_open(script, number):
  process = subprocess.Popen(
    [sys.executable, script, "--kind", "wait"],
    env=_ENVIRONMENT,
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
  )
  assert process.stdout.readline() == "ready\n"
  time.sleep(0.1)
  process.send_signal(number)
  output, error = process.communicate(timeout=30)
  assert process.returncode == 128 + number
  assert output == "closed\n" and error == "\nstopped: go on with the same command\n"


_IMPORTED_ON_TRIAL = """
import os, signal
try:
  os.kill(os.getpid(), signal.{name})
  os.getpid()  # handlers run between two instructions
except BaseException:
  print("taken for missing", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_an_import_swallows_ends_the_command_all_the_same(script, number):
  library = script.with_name("imported_on_trial.py")
  library.write_text(_IMPORTED_ON_TRIAL.format(name=number.name))
  ended = _run(sys.executable, script, "--kind", "import")
  assert ended.returncode == 128 + number
  assert ended.stdout == "taken for missing\nclosed\n"
  assert ended.stderr == "\nstopped: go on with the same command\n"
