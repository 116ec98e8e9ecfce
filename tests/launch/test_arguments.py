"""Numbers and addresses that no command can take are refused by their names before it starts."""

import socket

import pytest

from nerf2real.agents.supervision.statuses import NOT_SAVED
from nerf2real.core.files import disk_full
from tests.launch.test_identify import _log


@pytest.mark.parametrize(
  ("script", "arguments", "words"),
  [
    ("virtual_robot", ("--x", "nan"), "--x nan: expected a number"),
    ("virtual_robot", ("--seed", "-1"), "--seed -1: expected 0 to"),
    ("check_robot", ("--robot", "virtual", "--seconds", "0"), "--seconds 0: expected more than 0"),
    (
      *("check_robot", ("--robot", "virtual", "--seconds", "inf")),
      "--seconds inf: expected more than 0, and finite",
    ),
    ("evaluate", ("--time-limit", "inf"), "--time-limit inf: expected more than 0, and finite"),
    ("evaluate", ("--robot-seed", "1", "-2"), "--robot-seed -2: expected 0 to"),
    ("evaluate", ("--time-limit", "-1"), "--time-limit -1: expected more than 0"),
    ("distill", ("--run", "none", "--minutes", "0"), "--minutes 0: expected more than 0"),
    ("view", ("--host", "nowhere.invalid"), "--host nowhere.invalid: no address of this machine"),
  ],
)
def test_numbers_and_addresses_are_refused(run, script, arguments, words):
  ended = run(script, *arguments)
  assert ended.status == 2 and ended.err.startswith(f"error: {words}"), ended


def test_errors_of_the_system_begin_with_the_file(run, tmp_path):
  missing = tmp_path / "none.mcap"
  ended = run("replay_log", missing)
  assert ended.status == 1 and ended.err == f"error: {missing}: no such file or directory.\n"


def test_a_port_that_is_taken_is_named(run, tmp_path):
  with socket.create_server(("127.0.0.1", 0)) as taken:
    port = taken.getsockname()[1]
    ended = run("replay_log", _log(tmp_path / "log.mcap"), "--port", port)
  assert ended.status == 1 and f"127.0.0.1:{port}" in ended.err and "--port" in ended.err, ended


@pytest.mark.parametrize("content", ["[]", '{"settings": 3}', '{"settings": {"period": "long"}}'])
def test_a_search_begins_with_a_searchs_result_alone(run, tmp_path, content):
  (tmp_path / "gait.json").write_text(content)
  ended = run("tune_gait", "--start", tmp_path / "gait.json")
  assert ended.status == 1 and "no result of an earlier search" in ended.err, ended


def test_a_search_that_cannot_be_written_is_refused_before_its_first_round(run, tmp_path):
  (tmp_path / "file").write_text("")
  ended = run("tune_gait", "--out", tmp_path / "file" / "gait.json")
  assert ended.status == 1 and str(tmp_path / "file" / "gait.json") in ended.err, ended


def test_the_link_of_a_robot_that_was_killed_is_taken_over(run, tmp_path):
  link = tmp_path / "op3"
  link.symlink_to(tmp_path / "gone")
  ended = run("virtual_robot", "--link", link, "--seconds", 0.1, "--no-camera", "--world", "floor")
  assert ended.status == 0 and not link.is_symlink(), ended


def test_a_distillation_that_cannot_be_saved_says_so(run, tmp_path, monkeypatch):
  """The status tells the supervisor that a new start would fail as well."""

  class Full:
    def __init__(self, *_, **__):
      pass

    def run(self):
      raise disk_full("state.npz")

    def close(self):
      pass

  monkeypatch.setattr("nerf2real.agents.distill.learning.learner.Learner", Full)
  ended = run("distill_learner", "--run", tmp_path / "run", "--preset", "tiny")
  assert ended.status == NOT_SAVED, ended
  assert ended.err.splitlines()[-1] == (
    "error: Could not write state.npz: the disk is full. Free some space and try again."
  )
