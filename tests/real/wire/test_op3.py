"""Tests of the table of servos."""

import numpy as np
import pytest

from nerf2real.real.virtual.bus import board, devices
from nerf2real.real.wire import op3, opencr
from nerf2real.suite.op3 import constants


def test_ids_are_those_of_the_robot():
  assert {joint.name: joint.device for joint in op3.JOINTS} == devices.IDS
  assert op3.BOARD_ID == board.DEVICE
  assert tuple(joint.name for joint in op3.JOINTS) == constants.JOINT_NAMES


def test_counts_and_angles_are_inverse():
  wiring = op3.Wiring()
  angles = np.linspace(-1.5, 1.5, 20)
  np.testing.assert_allclose(wiring.to_angles(wiring.to_counts(angles)), angles, atol=0.0008)
  assert wiring.to_counts(np.zeros(20)).tolist() == [2048] * 20
  assert wiring.to_counts(np.full(20, np.pi / 2)).tolist() == [3072] * 20


def test_directions_and_offsets_are_applied():
  joints = list(op3.JOINTS)
  joints[3] = joints[3]._replace(direction=-1, offset=0.1)
  wiring = op3.Wiring(tuple(joints))
  counts = wiring.to_counts(np.full(20, 0.2))
  assert counts[3] == 2048 - round(0.3 * 4096 / (2 * np.pi))
  assert wiring.to_angles(counts)[3] == pytest.approx(0.2, abs=0.001)


def test_another_order_is_refused():
  with pytest.raises(ValueError, match="order"):
    op3.Wiring(op3.JOINTS[::-1])


def test_robotis_offset_files_are_read(tmp_path):
  path = tmp_path / "offset.yaml"
  path.write_text("offset:\n  l_knee: 0.0026\n  r_hip_yaw: -0.0175\ninit_pose: {}\n")
  offsets = dict(zip(constants.JOINT_NAMES, op3.read_offsets(path).offsets, strict=True))
  assert offsets["l_knee"] == 0.0026 and offsets["r_hip_yaw"] == -0.0175
  assert offsets["l_el"] == 0.0


@pytest.mark.parametrize(
  "text, message",
  [
    ("offset:\n  l_knee: 1.5\n", "units"),
    ("offset:\n  knee: 0.1\n", "unknown joints"),
    ("offset:\n  l_knee: nan\n", "units"),
    ("offsets: 3\n", "no joint offsets"),
    ("[", "no joint offsets"),
  ],
)
def test_bad_offset_files_are_refused(tmp_path, text, message):
  path = tmp_path / "offset.yaml"
  path.write_text(text)
  with pytest.raises(ValueError, match=message):
    op3.read_offsets(path)


def test_imu_counts_become_units_in_the_torsos_axes():
  data = bytes((119,)) + np.array([164, 0, -164, 0, 16384, 8192], "<i2").tobytes()
  found = opencr.decode(1.5, data)
  assert found.stamp == 1.5 and found.voltage == pytest.approx(11.9)
  np.testing.assert_allclose(found.gyroscope, np.deg2rad([-10, 0, -10]), atol=1e-9)
  np.testing.assert_allclose(found.accelerometer, [0, -9.80665, 9.80665 / 2], atol=1e-9)
