"""The replay of a recorded log: what the page holds, and what the server gives."""

import base64
import json
import re
import threading
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap_ros2.writer import Writer

from nerf2real.core.robot_logs import messages, reading
from nerf2real.core.robot_logs.writer import open_log
from nerf2real.real.recorder import process as recorder_process
from nerf2real.real.recorder import replay, replay_server

NAMES = ("l_knee", "r_knee")
START = 1_700_000_000.0


@pytest.fixture(scope="module")
def log(tmp_path_factory):
  """A log of 10000 readings with one short peak, written without the recorder's process."""
  path = tmp_path_factory.mktemp("log") / "run.mcap"
  with open_log(path) as out:

    def tell(kind, t, *arguments, **fields):
      build = recorder_process.BUILDERS[kind]
      out.write(build(recorder_process.nanoseconds(t), *arguments, **fields))

    for k in range(10000):
      t = START + 0.008 * k
      peak = 3.0 if k == 7777 else 0.0
      position = np.array([0.1 * np.sin(t), 0.5 + peak])
      tell("joint_state", t, messages.STATES, NAMES, position=position, velocity=np.zeros(2))
      if k % 4 == 0:
        tell("joint_state", t, messages.COMMANDS, NAMES, position=[0.2, 0.5])
    for k in range(20):
      tell("image", START + 4 * k, np.full((24, 32, 3), 10 * k, np.uint8))
    tell("temperature", START, "r_knee", 39.5)
    tell("battery", START, 11.75)
    tell("imu", START + 1, np.array([1.0, 2, 3]), np.array([0.0, 0, 9.8]))
  return path


def _data(page):
  found = re.search(r"^const data = (.*);$", page, re.MULTILINE)
  return json.loads(found[1])


def test_page_holds_what_was_recorded(log):
  shown = replay.load(log)
  assert shown.complete and shown.duration == pytest.approx(9999 * 0.008)
  data = _data(replay.page(shown, embed=True))
  assert data["joints"] == list(NAMES) and data["moving"] == "r_knee"
  assert set(data["series"]) == {
    "position",
    "velocity",
    "command",
    "turning rate",
    "specific force",
    "battery",
  }
  assert data["series"]["battery"] == {
    "unit": "V",
    "names": ["battery"],
    "t": [0.0],
    "y": [[11.75]],
  }
  assert data["temperatures"] == {"r_knee": {"t": [0.0], "y": [39.5]}}
  assert data["series"]["turning rate"]["y"] == [[1.0], [2.0], [3.0]]
  assert data["frames"][3] == pytest.approx(12.0)
  picture = cv2.imdecode(
    np.frombuffer(base64.b64decode(data["pictures"][3]), np.uint8), cv2.IMREAD_COLOR
  )
  assert picture.shape == (24, 32, 3) and abs(int(picture[5, 5, 0]) - 30) < 4


def test_thinned_lines_keep_their_peaks(log):
  position = _data(replay.page(replay.load(log), embed=False))["series"]["position"]
  assert len(position["t"]) <= 4000 and position["t"] == sorted(position["t"])
  assert max(position["y"][1]) == 3.5
  assert position["t"][position["y"][1].index(3.5)] == pytest.approx(7777 * 0.008, abs=1e-4)


def test_log_that_was_cut_off_is_shown_and_said(log, tmp_path):
  cut = tmp_path / "cut.mcap"
  data = log.read_bytes()
  cut.write_bytes(data[: int(0.6 * len(data))])
  shown = replay.load(cut)
  assert not shown.complete
  assert "cut off" in replay.page(shown, embed=False)


def test_nothing_to_show_is_said(tmp_path):
  path = tmp_path / "empty.mcap"
  with open_log(path):
    pass
  with pytest.raises(ValueError, match="holds no message that can be shown"):
    replay.load(path)


def test_server_gives_page_and_pictures(log):
  server = replay_server.make_server(replay.load(log), host="127.0.0.1", port=0)
  threading.Thread(target=server.serve_forever, daemon=True).start()
  try:
    base = f"http://127.0.0.1:{server.server_port}"
    page = urllib.request.urlopen(f"{base}/").read().decode()
    assert "run.mcap" in page and "pictures" not in _data(page)
    jpeg = urllib.request.urlopen(f"{base}/frame/19").read()
    assert abs(int(cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1)[0, 0, 0]) - 190) < 4
    with pytest.raises(urllib.error.HTTPError, match="404"):
      urllib.request.urlopen(f"{base}/frame/20")
  finally:
    server.shutdown()
    server.server_close()


def test_a_log_without_our_extra_topics(tmp_path):
  measured = Path("../shared/data/measured/emps/held_1.mcap")
  if not measured.exists():
    pytest.skip(f"{measured} is absent: the data sets beside the checkout are not here.")
  shown = replay.load(measured)
  assert {"position", "commanded effort"} <= set(shown.series) and not shown.frames
  assert shown.series["position"].names == shown.series["commanded effort"].names


def test_topics_that_are_not_shown_may_be_anything(tmp_path):
  """A robot's whole bag holds messages without a header, and channels without a schema."""
  path = tmp_path / "bag.mcap"
  with path.open("wb") as stream:
    writer = Writer(stream)
    joints = writer.register_msgdef(messages.JOINT_STATE, messages.definition(messages.JOINT_STATE))
    text = writer.register_msgdef("std_msgs/msg/String", "string data\n")
    note = writer._writer.register_channel(topic="/note", message_encoding="json", schema_id=0)
    for k in range(200):
      ns = 10**18 + k * 10**7
      times = {"log_time": ns, "publish_time": ns}
      for topic in (messages.STATES, messages.COMMANDS):
        told = messages.joint_state(ns, topic, NAMES, position=[0.1 * k, 0.0])[2]
        writer.write_message(topic, joints, told, **times)
      writer.write_message("/rosout", text, {"data": "x"}, **times)
      writer._writer.add_message(channel_id=note, data=b"{}", **times)
    writer.finish()
  assert {"position", "command"} == set(replay.load(path).series)
  assert reading.read_log(path).joints == NAMES
