"""What cannot succeed is refused at once, in one line, and leaves nothing."""

import os
import shutil
import socket
import threading
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from nerf2real.real.safety.operator import Terminal
from nerf2real.real.virtual.body import Body
from nerf2real.real.virtual.camera import Eyes
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.scenes.bundle import BUILT_IN
from tests.launch.test_identify import _log


@pytest.mark.parametrize(
  ("script", "arguments", "status", "words"),
  [
    ("view", ("--port", "80000"), 2, "expected 0 (a free one) to 65535"),
    ("replay_log", ("{log}", "--port", "-1"), 2, "expected 0 (a free one) to 65535"),
    (
      *("local_distributed", ("--env", "agents:cue", "--run", "{out}", "--port", "80000"), 2),
      "--port 80000",
    ),
    ("local_distributed", ("--run", "{out}", "--resume"), 2, "holds no checkpoint"),
    ("distill", ("--run", "{out}", "--resume"), 2, "holds no checkpoint"),
    ("learner", ("--run", "{out}", "--resume"), 2, "holds no checkpoint"),
    ("distill_learner", ("--run", "{out}", "--resume"), 2, "holds no run to continue"),
    ("learner", ("--run", "{out}", "--env", "agents:none"), 2, "has no task 'none'"),
    (
      "learner",
      (
        "--run",
        "{out}",
      ),
      2,
      "Say what to learn",
    ),
    ("make_scene", ("--capture", "builtin", "--out", "{out}", "--marker-side", "20"), 1, "metres"),
    ("make_scene", ("--capture", "builtin", "--out", "{out}", "--marker-side", "0"), 1, "metres"),
    ("make_scene", ("--capture", "none.mp4", "--out", "{out}"), 1, "none.mp4"),
    ("film_room", ("--out", "{out}.txt"), 1, "expected one that ends in .mp4"),
    ("show_belief", ("shipped", "--out", "{log}/belief.png"), 1, "log.mcap"),
    ("make_scene", ("--capture", "{log}", "--out", "{out}"), 1, "log.mcap"),
    ("evaluate", ("--policy", "none", "--out", "{out}"), 1, "none"),
    ("evaluate", ("--scene", "none", "--out", "{out}"), 1, "none"),
    ("evaluate", ("--dry-run", "--out", "{out}"), 1, "expected --plant robot"),
    ("identify", ("--model", "none.xml", "--logs", "{log}", "--out", "{out}"), 1, "none.xml"),
    ("rollout", ("--scene", "none", "--video", "{out}/x.mp4"), 1, "none"),
    ("close_loop", ("--policy", "none", "--out", "{out}"), 1, "none"),
  ],
)
def test_refused_at_once(run, tmp_path, script, arguments, status, words):
  log, out = tmp_path / "log.mcap", tmp_path / "out" / "deep"
  log.write_text("no log")
  ended = run(script, *(text.format(log=log, out=out) for text in arguments))
  assert ended.status == status, ended
  (line,) = ended.err.splitlines()
  assert line.startswith("error: ") and words.format(out=out) in line, line
  assert sorted(path.name for path in tmp_path.iterdir()) == ["log.mcap"]


@pytest.mark.parametrize(
  "arguments", [(), ("--policy", "walker"), ("--policy", "walker", "--find-severity")]
)
def test_a_folder_of_something_else_is_not_written(run, tmp_path, arguments):
  (tmp_path / "notes.txt").write_text("mine")
  ended = run("close_loop", *arguments, "--hidden", "command_delay:0.1", "--out", tmp_path)
  assert ended.status == 1, ended
  (line,) = ended.err.splitlines()
  assert line.startswith(f"error: {tmp_path} holds notes.txt and no loop_settings.json: expected")
  assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
  ("script", "arguments", "late"),
  [
    (
      "learner",
      ("--env", "dm_control:cartpole:swingup", "--preset", "state"),
      "nerf2real.agents.processes.learner.Learner",
    ),
    (
      "distill_learner",
      ("--preset", "tiny", "--relabel", "{out}"),
      "nerf2real.agents.distill.relabelling.relabel_for",
    ),
  ],
)
def test_a_taken_endpoint_is_refused_before_anything_is_prepared(
  run, tmp_path, monkeypatch, script, arguments, late
):
  """Compiling the updates or labelling episodes anew takes minutes."""
  began = []
  monkeypatch.setattr(late, lambda *_, **__: began.append(late))
  out = tmp_path / "run"
  with socket.create_server(("127.0.0.1", 0)) as other:
    endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
    found = (text.format(out=out) for text in arguments)
    ended = run(script, "--run", out, "--listen", endpoint, *found)
  assert ended.status == 2 and not began, ended
  assert ended.err.strip().splitlines()[-1].startswith(f"error: Cannot listen on {endpoint}: ")
  assert not out.exists()


@pytest.mark.parametrize(
  ("script", "arguments"),
  [("export_scene", ("--to", "glb", "--out", "{out}.glb")), ("view", ("--port", "0"))],
)
def test_a_field_that_was_cut_off_is_one_line(run, tmp_path, script, arguments):
  """As a download that ended early leaves it."""
  room = tmp_path / "room"
  shutil.copytree(BUILT_IN, room)
  field = room / "field.safetensors"
  os.truncate(field, field.stat().st_size // 2)
  ended = run(script, room, *(text.format(out=tmp_path / "out") for text in arguments))
  assert ended.status == 1, ended
  line = ended.err.strip().splitlines()[-1]
  assert line.startswith(f"error: {field} is damaged: found "), ended.err
  assert "Traceback" not in ended.err and sorted(tmp_path.iterdir()) == [room]


def test_a_dry_run_needs_no_terminal_and_asks_for_nothing(run, monkeypatch, capsys):
  """Nothing moves, so nobody must hold the robot."""
  with open(os.devnull) as nowhere, VirtualRobot(stepped=True) as robot:
    robot.operator = Terminal(nowhere.fileno())
    monkeypatch.setattr("nerf2real.real.check.connected", lambda _: _Opened(robot.connection()))
    ended = run("check_robot", "--robot", "virtual", "--dry-run", "--seconds", "0.5")
  assert ended.status == 0 and ended.out.strip().endswith("passed"), ended
  assert "HOLD" not in ended.out


def test_a_virtual_robot_whose_physics_ends_says_so(run, monkeypatch, tmp_path):
  advance, link = Body.advance, tmp_path / "op3"

  def fail(self, until):
    if threading.current_thread().name == "virtual wire":
      raise FloatingPointError("unstable physics")
    return advance(self, until)

  monkeypatch.setattr(Body, "advance", fail)
  options = ("--world", "floor", "--no-camera", "--link", link, "--seconds", "100")
  ended = run("virtual_robot", *options)
  assert ended.status == 1, ended
  (line,) = ended.err.splitlines()
  assert line.startswith("error: The virtual robot ended (FloatingPointError: unstable physics)")
  assert not link.is_symlink()


@pytest.mark.parametrize(("asked", "says"), [(8080, True), (8081, False), (0, False)])
def test_a_page_on_another_port_than_was_asked_for_is_told(run, monkeypatch, asked, says):
  server = SimpleNamespace(get_port=lambda: 8081, stop=lambda: None)
  monkeypatch.setattr("nerf2real.scenes.viewing.bundle_viewer.view_bundle", lambda *_, **__: server)
  event = SimpleNamespace(wait=lambda: None)
  monkeypatch.setattr("nerf2real.launch.view.threading", SimpleNamespace(Event=lambda: event))
  ended = run("view", "--port", asked)
  assert ended.status == 0 and "open http://127.0.0.1:8081 " in ended.out
  told = "port 8080 is taken by another program: the page is on port 8081\n"
  assert ended.err == (told if says else "")


def test_a_virtual_robot_whose_camera_ends_says_so(run, monkeypatch, tmp_path):
  link, taken = tmp_path / "op3", []

  def picture(self, time=None):
    if len(taken) == 3:
      raise OSError("the context is lost")
    taken.append(threading.current_thread().name)
    return np.zeros((24, 32, 3), np.uint8)

  monkeypatch.setattr(Eyes, "picture", picture)
  ended = run("virtual_robot", "--world", "floor", "--link", link, "--seconds", "100")
  assert ended.status == 1, ended
  (line,) = ended.err.splitlines()
  assert line == (
    "error: The virtual robot's camera ended (OSError: the context is lost): no pictures come any "
    "more; start it again."
  )
  assert not link.is_symlink()


class _Opened:
  def __init__(self, connection):
    self._connection = connection

  def __enter__(self):
    return self._connection

  def __exit__(self, *_):
    pass


def test_a_log_that_can_be_read_is_served(run, tmp_path):
  """The page of a good log is written: the refusals above are of the arguments."""
  log = _log(tmp_path / "log.mcap")
  ended = run("replay_log", log, "--html", tmp_path / "log.html")
  assert ended.status == 0 and (tmp_path / "log.html").stat().st_size > 10_000


def test_a_recording_that_is_there_is_kept(run, tmp_path):
  log = tmp_path / "log.mcap"
  log.write_bytes(b"a recording")
  ended = run("check_robot", "--robot", "/dev/none", "--record", log)
  assert ended.status == 2 and f"{log} is there already" in ended.err, ended
  assert log.read_bytes() == b"a recording"


def test_of_a_robot_that_is_not_reached_no_recording_is_left(run, tmp_path):
  ended = run("check_robot", "--robot", "/dev/none", "--record", tmp_path / "new" / "log.mcap")
  assert ended.status == 1 and "/dev/none" in ended.err, ended
  assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
  ("option", "words"),
  [
    (("--every", 0), "expected 1 (each) or more"),
    (("--corners", 2, 7), "Found 2 x 7 inner corners, expected 3 or more each"),
  ],
)
def test_boards_that_nobody_can_find(run, tmp_path, option, words):
  film = cv2.VideoWriter(
    str(tmp_path / "board.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (80, 60)
  )
  film.write(np.zeros((60, 80, 3), np.uint8))
  film.release()
  ended = run("calibrate_camera", tmp_path / "board.avi", *option)
  assert ended.status == 1 and words in ended.err, ended
