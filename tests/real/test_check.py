"""Tests of the command that checks a robot."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nerf2real.real import check
from nerf2real.real.virtual.bus.devices import IDS
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.suite.op3 import constants

_ROOT = Path(__file__).parents[2]


def _check(robot, **arguments):
  return check.check(robot.connection(), seconds=0.5, **arguments)


def test_a_good_robot_passes_and_its_joints_are_listed():
  with VirtualRobot(stepped=True) as robot:
    lines = _check(robot)
    assert lines[-1] == "passed"
    rows = {line.split()[0]: line.split() for line in lines[1:21]}
    assert set(rows) == set(constants.JOINT_NAMES)
    knee = rows["l_knee"]
    assert abs(float(knee[2])) < 0.1 and float(knee[4]) == pytest.approx(25, abs=2)
    assert not robot.body.motors.enabled.any()


def test_a_dry_run_passes_and_moves_nothing():
  with VirtualRobot(stepped=True) as robot:
    goals = robot.body.motors.goal.copy()
    assert _check(robot, dry_run=True)[-1] == "passed"
    np.testing.assert_array_equal(robot.body.motors.goal, goals)
    assert robot.truth().held


def test_a_failing_robot_is_reported():
  with VirtualRobot(stepped=True) as robot:
    after = robot.body.after_step

    def overheat(time):
      after(time)
      if time > 2.0:
        robot.faults.heat[IDS["l_knee"]] = 75.0

    robot.body.after_step = overheat
    try:
      last = _check(robot)[-1]
    except RuntimeError as error:  # if it comes before the episode
      last = str(error)
    assert "temperature (l_knee: 75 degrees C)" in last


def test_a_missing_port_is_one_line():
  found = subprocess.run(
    [sys.executable, "launch/check_robot.py", "--robot", "/dev/none"],
    cwd=_ROOT,
    capture_output=True,
    text=True,
    timeout=120,
  )
  assert found.returncode == 1
  assert found.stderr.startswith("error: ") and "/dev/none" in found.stderr
  assert found.stderr.count("\n") == 1
