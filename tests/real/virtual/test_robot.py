"""Tests of the whole virtual robot: its camera, its real time, its process, its command."""

import os
import re
import select
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nerf2real.real.virtual.camera import LENS, VirtualCamera
from nerf2real.real.virtual.process import VirtualRobotProcess
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.real.wire.bus import Bus, BusError
from nerf2real.real.wire.servos import Servos
from nerf2real.scenes.builtin.mujoco_renderer import EglMissingError
from nerf2real.suite.op3 import constants

_ROOT = Path(__file__).parents[3]
_TARGET = np.array([1.2, 0.15, 0.5])  # m, middle of a red box


def _furnish(spec):
  spec.worldbody.add_geom(
    type=mujoco.mjtGeom.mjGEOM_BOX,
    size=[0.02, 0.08, 0.08],
    pos=_TARGET.tolist(),
    rgba=[1, 0, 0, 1],
    group=2,
  )
  spec.worldbody.add_light(
    type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=[1, 0, -0.3], ambient=[0.4, 0.4, 0.4]
  )


def _hold_pose(robot):
  for index, angle in enumerate(constants.standing_targets()):
    robot.body.motors.set_goal(index, round(2048 + angle * 4096 / (2 * np.pi)), 0.0)
  robot.body.motors.enabled[:] = True


def _advance(robot, seconds):
  robot.clock.advance(robot.clock.now() + seconds)
  robot.truth()


def _patiently(work):
  """Repeats what needs answers in time until a busy machine gives it the time."""
  for _ in range(20):
    try:
      return work()
    except BusError as error:
      last = error
  raise last


def test_the_camera_sees_the_world_from_the_head():
  with VirtualRobot(stepped=True, camera=VirtualCamera(noise=0.0), furnish=_furnish) as robot:
    _hold_pose(robot)
    robot.body.motors.set_goal(1, 2048, 0.0)  # the head level
    _advance(robot, 1.0)
    try:
      picture, age = robot.camera.read()
    except EglMissingError as error:
      pytest.skip(str(error))
    assert picture.shape == (240, 320, 3)
    assert 0.04 <= age < 0.04 + 1 / 30 + 0.002
    red = (picture[..., 0] > 100) & (picture[..., 1] < 80)
    assert red.sum() > 100
    model, data = robot.body.model, robot.body.data
    camera = model.camera("op3/head_camera").id
    seen = (_TARGET - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)
    point = LENS.distort(np.array([seen[0], -seen[1]]) / -seen[2])
    expected = [LENS.fy * point[1] + LENS.cy, LENS.fx * point[0] + LENS.cx]
    np.testing.assert_allclose(np.argwhere(red).mean(0) + 0.5, expected, atol=2.0)

    # a picture is what was seen its latency ago, and none comes while it is frozen
    robot.place(0.0, 0.6, 0.0)
    before = robot.camera.read()[0]
    np.testing.assert_array_equal(before, picture)
    _advance(robot, 0.2)
    assert not np.array_equal(robot.camera.read()[0], picture)
    robot.camera.frozen = True
    _advance(robot, 0.7)
    assert robot.camera.read()[1] > 0.7


def test_in_real_time_it_is_read_through_its_port():
  with VirtualRobot() as robot:
    bus = Bus(robot.port)
    try:
      _patiently(Servos(bus).power_on)
      _patiently(Servos(bus).set_up)
      end = time.monotonic() + 60
      found = None
      while found is None and time.monotonic() < end:  # a busy machine loses some
        found = bus.read_joints()
      assert found is not None
      assert abs(time.monotonic() - found.stamps.mean()) < 1.0
      assert abs(robot.truth().time - time.monotonic()) < 1.0
      np.testing.assert_allclose(found.voltages, 12.0, atol=0.3)
    finally:
      bus.close()


def test_in_a_process_of_its_own_it_does_what_it_is_told():
  with VirtualRobotProcess() as robot:
    assert os.path.exists(robot.port)
    robot.place(0.4, -0.2, 0.5)
    truth = robot.truth()
    assert truth.held and truth.yaw == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(truth.position[:2], [0.4, -0.2], atol=0.01)
    robot.set_faults(cut=True)
    bus = Bus(robot.port)
    assert bus.read_imu() is None
    bus.close()
    with pytest.raises(RuntimeError, match="no fault 'flood'"):
      robot.set_faults(flood=1)
    with pytest.raises(RuntimeError, match="ball=True"):
      robot.place_ball(0.0, 0.0)
    assert robot.processor_time() > 0
    robot._process.kill()
    with pytest.raises(RuntimeError, match="process has ended: start it again"):
      robot.truth()
  with pytest.raises(RuntimeError, match="Unknown world"):
    VirtualRobotProcess(world="moon")


def test_the_command_prints_the_port_and_ends_by_itself(tmp_path):
  link = tmp_path / "op3"
  process = subprocess.Popen(
    [
      sys.executable,
      "launch/virtual_robot.py",
      "--world",
      "floor",
      "--no-camera",
      "--link",
      str(link),
      "--seconds",
      "8",
    ],
    cwd=_ROOT,
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
    env=os.environ | {"PYTHONPATH": str(_ROOT)},
  )
  try:
    ready, _, _ = select.select([process.stdout], [], [], 90)
    line = process.stdout.readline() if ready else ""
    assert re.fullmatch(r"port: /dev/pts/\d+\n", line), line
    end = time.monotonic() + 60
    while not link.exists() and time.monotonic() < end:
      time.sleep(0.02)
    bus = Bus(str(link))
    end = time.monotonic() + 60
    while bus.read_imu() is None and time.monotonic() < end:
      pass
    assert bus.counts.imu_readings == 1
    bus.close()
  finally:
    if process.poll() is None:
      process.wait(60)
  assert process.returncode == 0, process.stderr.read()
  assert not link.exists()
