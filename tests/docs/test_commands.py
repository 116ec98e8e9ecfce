"""The tables of commands agree with the READMEs; docs/check_*.py run the commands themselves."""

import importlib.util
import tomllib
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[2]


def _load(name):
  spec = importlib.util.spec_from_file_location(name, _ROOT / f"docs/{name}.py")
  module = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  return module


@pytest.fixture(scope="module")
def checker():
  return _load("check_commands")


def test_every_entry_is_a_command_of_a_readme(checker):
  printed = {command for _, command in checker.commands()}
  assert set(checker.table()) - printed == set()
  assert len(printed) > 50


def test_commands_with_what_is_not_there_have_an_entry(checker):
  """Names of runs, devices and other machines are examples: such commands cannot run as printed."""
  known = checker.table()
  for path, command in checker.commands():
    if any(word in command for word in ("runs/", "/dev/", "../", "tls/", "X", "out/x", "room.mp4")):
      assert command in known, f"{path}: {command}"


def test_a_command_is_run_as_its_entry_says(checker):
  assert checker.run("python -c 'print(3)'", {}).detail == "3"
  assert checker.run("python -c 'print(3)'", {"skip": "why"}) == ("left out", 0.0, "why")
  assert checker.run("python x.py", {"run": "python -c 'exit(3)'"}).state == checker.FAILED
  waiting = "python -c 'import time; print(\"open it\", flush=True); time.sleep(60)'"
  ended = checker.run(waiting, {"serves": "open"})
  assert ended.state == checker.FAILED and "KeyboardInterrupt" in ended.detail


def test_the_page_of_results_is_of_these_commands_and_none_failed(checker):
  rows = checker.recorded()
  assert rows and set(rows) <= {command for _, command in checker.commands()}
  assert [row for row in rows.values() if checker.FAILED in row] == []


def test_misuses_are_many_and_each_names_a_script():
  cases = tomllib.loads((_ROOT / "docs/misuse.toml").read_text())["case"]
  assert len(cases) >= 60
  assert len({case["command"] for case in cases}) == len(cases)
  for case in cases:
    assert (_ROOT / "launch" / f"{case['command'].split()[0]}.py").exists()
    assert case["status"] in (1, 2) and case["says"]


def test_a_misuse_is_found_where_a_command_leaves_something(tmp_path):
  checker = _load("check_misuse")
  case = {"command": "x", "says": "no such", "status": 1}
  found = checker.Found(1, "error: no such file", False, (), 0.1)
  assert checker.problems(case, found) == []
  worse = checker.Found(0, "done", True, ("out",), 0.1)
  assert len(checker.problems(case, worse)) == 4
