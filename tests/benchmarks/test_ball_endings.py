"""Where trials of ball pushing end."""

import dataclasses

import numpy as np
import pytest

from benchmarks.learning.ball_endings import ending_of
from nerf2real.suite.tasks.workspace import Workspace
from tests.evaluation.fakes import episode

WORKSPACE = Workspace(np.array([2.0, 1.0]))  # target cell: 2.5 to 3.5 m, 1.5 to 2.5 m


def _ending(ball, **changes):
  found = dataclasses.replace(
    episode("fall"),
    path=[[0.2 * i, 2.0, 1.0, 0.0] for i in range(len(ball))],
    ball_path=[[0.2 * i, *xy] for i, xy in enumerate(ball)],
    **changes,
  )
  return ending_of(found, WORKSPACE)


def test_a_ball_that_was_left_alone():
  found = _ending([(2.3, 1.4)] * 4, duration=0.8)
  assert (found.stage, found.outcome, found.duration) == ("never_moved", "fall", 0.8)
  assert found.robot_to_ball == pytest.approx(0.5)
  assert found.ball_to_target == pytest.approx(np.hypot(0.2, 0.1))
  assert found.ball_to_edge == pytest.approx(1.1) and found.rested == pytest.approx(0.6)


def test_a_ball_that_was_pushed_beside_the_target():
  found = _ending([(2.0, 1.0), (2.3, 1.0), (2.7, 1.4), (2.7, 1.4), (2.7, 1.4)])
  assert found.stage == "moved" and found.rested == pytest.approx(0.4)
  assert found.ball_to_target == pytest.approx(0.1) and found.ball_to_edge == pytest.approx(0.8)
