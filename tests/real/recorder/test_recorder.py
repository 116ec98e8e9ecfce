"""The recorder against other readers of MCAP, and what is left when processes are killed."""

import os
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from mcap_ros2.reader import read_ros2_messages

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs import reading as logs
from nerf2real.core.robot_logs import streaming as recording
from nerf2real.real.recorder.recorder import Recorder

NAMES = ("head_pan", "l_knee", "r_knee")
START = 1_700_000_000.25


def _picture(level):
  picture = np.zeros((48, 64, 3), np.uint8)
  picture[..., 0], picture[:, 32:, 2] = level, 200
  return picture


def _write(recorder, count, *, wait=0.0):
  for k in range(count):
    t = START + 0.008 * k
    recorder.command(t, NAMES, [0.1, 0.2 * k, 0.3])
    recorder.joints(
      t,
      NAMES,
      [0.01 * k, 0.2, 0.3],
      [1.0, 2.0, 3.0],
      [0.1, 0.2, 0.3],
      [12.0, 11.9, 11.8],
      [0.5, -0.5, 0.0],
      stamps=[t, t + 0.001, t + 0.002],
    )
    recorder.imu(t, [0.1, 0.2, 0.3], [0.0, 0.0, 9.81], [0.0, 0.0, -1.0])
    if k % 5 == 0:
      recorder.image(t, _picture(40))
    time.sleep(wait)


def test_log_is_what_was_told(tmp_path):
  path = tmp_path / "new" / "log.mcap"
  lens = Camera(width=64, height=48, fx=50.0, fy=51.0, cx=32.0, cy=24.0, k1=0.1, p2=-0.01)
  with Recorder(path) as recorder:
    recorder.camera_info(START, lens)
    _write(recorder, 200)
    recorder.battery(START, 11.5)
    recorder.temperature(START, "l_knee", 41.0)
  assert recorder.dropped == 0 and not recorder.alive and recording.is_complete(path)
  found: dict[str, list] = {}
  for item in read_ros2_messages(str(path)):  # the library's own, indexed reader
    found.setdefault(item.channel.topic, []).append(item)
  joint = found[messages.STATES][7]
  assert joint.ros_msg.name == list(NAMES) and joint.schema.name == "sensor_msgs/msg/JointState"
  assert joint.ros_msg.position == pytest.approx([0.07, 0.2, 0.3])
  assert joint.log_time_ns == pytest.approx(1e9 * (START + 0.056), abs=300)
  assert found[messages.STAMPS][7].ros_msg.effort == pytest.approx([0, 1e-3, 2e-3], abs=1e-6)
  assert found[messages.CURRENTS][0].ros_msg.effort == pytest.approx([0.1, 0.2, 0.3])
  info = found[messages.CAMERA_INFO][0].ros_msg
  # The centre of the upper left pixel is (0, 0) in ROS, (0.5, 0.5) in core.geometry.
  assert info.k[2] == 31.5 and info.k[5] == 23.5 and info.d[0] == 0.1 and info.d[3] == -0.01
  image = np.frombuffer(found[messages.IMAGE][0].ros_msg.data, np.uint8)
  shown = cv2.imdecode(image, cv2.IMREAD_COLOR)[..., ::-1]
  assert np.abs(shown[:, :28].astype(int) - _picture(40)[:, :28]).max() < 12
  assert len(found[messages.IMAGE]) == 40
  # The reader for identification takes it as it is.
  log = logs.read_log(path)
  assert log.joints == NAMES and log.duration == pytest.approx(199 * 0.008)
  assert log.commands.position[3, 1] == pytest.approx(0.6)
  assert log.pwm is not None and log.pwm.effort[0] == pytest.approx([0.5, -0.5, 0.0])
  assert log.imu.linear_acceleration[5] == pytest.approx([0, 0, 9.81])
  assert log.temperatures["l_knee"].value == pytest.approx([41.0])


def test_killed_recorder_leaves_readable_file(tmp_path):
  path = tmp_path / "log.mcap"
  recorder = Recorder(path)
  begin = time.monotonic()
  _write(recorder, 160, wait=0.006)
  took = time.monotonic() - begin
  os.kill(recorder.pid, signal.SIGKILL)
  recorder._process.wait()
  recorder.command(START + 99, NAMES, [0, 0, 0])  # the control loop goes on
  assert recorder.dropped >= 1 and not recorder.alive
  recorder.close()
  assert not recording.is_complete(path)
  times = [
    r.time for r in recording.read_messages(path, recover=True) if r.topic == messages.STATES
  ]
  lost = (160 - len(times)) / 160 * took
  assert len(times) > 20 and lost < 0.6, f"{lost:.2f} s lost"
  assert np.diff(times) == pytest.approx(0.008, abs=1e-6)


def test_file_is_closed_when_control_process_is_killed(tmp_path):
  path = tmp_path / "log.mcap"
  program = (
    "import sys, time\n"
    "from nerf2real.real.recorder.recorder import Recorder\n"
    "r = Recorder(sys.argv[1])\n"
    "for k in range(50): r.battery(1e9 + k, 12.0 - 0.01 * k)\n"
    "time.sleep(0.3); print('written', r.pid, flush=True); time.sleep(60)"
  )
  process = subprocess.Popen([sys.executable, "-c", program, path], stdout=subprocess.PIPE)
  try:
    recorder_pid = int(process.stdout.readline().split()[1])
  finally:
    process.kill()
    process.wait()
  deadline = time.monotonic() + 60
  while time.monotonic() < deadline and not recording.is_complete(path):
    time.sleep(0.05)
  voltages = [r.message.voltage for r in recording.read_messages(path)]
  assert recording.is_complete(path) and recorder_pid
  assert voltages == pytest.approx([12.0 - 0.01 * k for k in range(50)], abs=1e-5)


def test_unwritable_path_is_one_line(tmp_path):
  with pytest.raises(OSError, match="cannot write .*Is a directory"):
    Recorder(tmp_path)


def test_other_files_are_refused(tmp_path):
  path = tmp_path / "x.mcap"
  path.write_bytes(b"hello world")
  with pytest.raises(ValueError, match="not an MCAP file"):
    list(recording.read_messages(path))


def test_empty_recording_is_complete(tmp_path):
  path = tmp_path / "log.mcap"
  Recorder(path).close()
  assert recording.is_complete(path) and list(recording.read_messages(path)) == []
