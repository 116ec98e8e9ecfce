"""Where trials of ball pushing end."""

import base64
import dataclasses

import cv2
import numpy as np
import pytest

from benchmarks.learning.ball_endings import ending_of
from nerf2real.evaluation.episodes import Moment
from nerf2real.scenes.geometry.free_space import FREE, FreeSpaceMap
from nerf2real.suite.tasks.workspace import Workspace
from tests.evaluation.fakes import episode

WORKSPACE = Workspace(np.array([2.0, 1.0]))  # target cell: 2.5 to 3.5 m, 1.5 to 2.5 m
FLOOR = FreeSpaceMap(  # 4 x 4 m
  cells=np.full((40, 40), FREE, np.uint8), resolution=0.1, origin=np.zeros(2), radius=0.2
)


def _ending(ball, **changes):
  found = dataclasses.replace(
    episode("fall"),
    path=[[0.2 * i, 2.0, 1.0, 0.0] for i in range(len(ball))],
    ball_path=[[0.2 * i, *xy] for i, xy in enumerate(ball)],
    **changes,
  )
  return ending_of(found, WORKSPACE, FLOOR)


def _moment(color):
  picture = np.full((30, 40, 3), (70, 110, 150), np.uint8)  # wood, as OpenCV has it
  picture[:2, :2] = color
  png = base64.b64encode(cv2.imencode(".png", picture)[1].tobytes()).decode()
  return Moment(
    time=0.0, position=None, logits=[0.0], means=[[0.0] * 3], stddevs=[[1.0] * 3], picture=png
  )


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


def test_what_a_robot_saw_and_where_it_stayed():
  path = [[0.2 * i, x, 1.0, 0.0] for i, x in enumerate((1.0, 1.5, 2.0, 2.05, 2.0))]
  moments = [_moment((22, 97, 207)), _moment((40, 40, 150)), _moment((21, 89, 181))]
  found = dataclasses.replace(
    episode("lost"), path=path, ball_path=[[0.0, 3.85, 1.0]], moments=moments
  )
  ending = ending_of(found, WORKSPACE, FLOOR)
  assert ending.stayed == pytest.approx(0.4)
  assert ending.in_view == pytest.approx(2 / 3)  # the second is of the carpet's red
  assert ending.ball_to_matter == pytest.approx(0.15)  # from the rim of the map
