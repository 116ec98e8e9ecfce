"""What a policy believes at a trial's start."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from benchmarks.learning.start_pictures import Film, errors, record, show
from nerf2real.evaluation.plants.plant import Sight
from nerf2real.suite.op3.constants import CONTROL_TIMESTEP
from nerf2real.suite.pose import Pose

AGE = 0.06  # s, of a picture when it is read


class Believer:
  """A policy that believes in the place that its picture's first pixel names."""

  def __init__(self, components):
    self._logits, self._yaws = np.array(components).T

  def initial_state(self):
    return 0

  def step(self, picture, proprioception, state):
    assert proprioception.shape == (3,) and not proprioception.any()
    assert state == picture[0, 0, 2]
    return SimpleNamespace(embedding=picture[0, 0], state=state + 1)

  def believed_position(self, embedding):
    return embedding[:2].astype(float)

  def belief(self, embedding):
    means = np.stack([np.full(len(self._yaws), embedding[0]), self._logits, self._yaws], axis=1)
    return self._logits, means, np.ones_like(means)


class Corridor:
  """A plant whose robot walks 0.1 m a step."""

  def __init__(self, *, collides=None):
    self._collides, self._steps = collides, 0
    self.goal = np.array([9.0, 0.0])
    camera = SimpleNamespace(read=lambda: (None, AGE))
    clock = SimpleNamespace(now=lambda: 5.0 + self._steps * CONTROL_TIMESTEP)
    self.robot = SimpleNamespace(camera=camera, clock=clock)

  def start(self, trial):
    return self._timestep()

  def step(self, action):
    assert action == self._steps  # of the picture before
    self._steps += 1
    return self._timestep()

  def sight(self):
    pose = Pose(0.1 * self._steps, -1.0, 0.5)
    return Sight(pose, None, self._steps == self._collides, False)

  def _timestep(self):
    picture = np.full((2, 2, 3), self._steps, np.uint8)
    return SimpleNamespace(observation={"camera": picture}, last=lambda: False)


def _recorded(plant, seconds):
  def act(observation, *, goal, sight):
    assert goal is plant.goal
    return int(observation["camera"][0, 0, 0])

  driver = SimpleNamespace(reset=lambda sight: None, act=act)
  times = SimpleNamespace(picture=lambda time: np.array([time]))
  return record(plant, driver, times, 10, seconds)


def test_the_simulations_picture_is_of_the_moment_that_the_robots_was_taken():
  film = _recorded(Corridor(), 4 * CONTROL_TIMESTEP)
  assert film.robot[:, 0, 0, 0].tolist() == [0, 1, 2, 3]
  np.testing.assert_allclose(film.simulated[:, 0], 5.0 - AGE + np.arange(4) * CONTROL_TIMESTEP)
  np.testing.assert_allclose(film.place, [[0.1 * i, -1.0] for i in range(4)])
  np.testing.assert_allclose(film.yaw, 0.5)


def test_a_film_ends_where_the_robot_collides():
  assert len(_recorded(Corridor(collides=2), 4.0).robot) == 2


def test_errors_are_of_the_mean_place_and_of_the_likeliest_heading():
  pictures = np.zeros((3, 2, 2, 3), np.uint8)
  pictures[:, 0, 0] = [(0, 0, 0), (3, 4, 1), (6, 8, 2)]  # the place, and which of the film
  place = np.array([[0.0, 0.0], [0.0, 0.0], [6.0, 7.5]])
  yaw = np.array([3.0, -3.1, -np.pi / 2])
  film = Film(pictures, pictures, place, yaw)
  policy = Believer([(0.1, 0.0), (2.0, 3.1), (1.9, -1.0)])  # 3.1 rad is the likeliest
  found = errors(
    SimpleNamespace(policy=policy, layout=SimpleNamespace(state_size=3)), pictures, film
  )
  np.testing.assert_allclose(found.distance, [0.0, 5.0, 0.5])
  # The short way round: 6.2 rad apart are 0.083, and 4.67 are 1.61.
  np.testing.assert_allclose(found.turn, [0.1, 2 * np.pi - 6.2, 1.5 * np.pi - 3.1], atol=1e-6)


@pytest.mark.parametrize(("seconds", "columns"), [(0.5, 1), (2.5, 3)])
def test_a_picture_of_every_second_is_shown_the_robots_above(tmp_path, seconds, columns):
  count = round(seconds / CONTROL_TIMESTEP)
  shade = np.arange(count, dtype=np.uint8)[:, None, None, None]
  film = Film(
    np.broadcast_to(shade, (count, 2, 4, 3)) + np.array([100, 0, 0], np.uint8),
    np.broadcast_to(shade, (count, 2, 4, 3)),
    np.zeros((count, 2)),
    np.zeros(count),
  )
  show(film, tmp_path / "shown" / "trial.png")
  shown = cv2.imread(str(tmp_path / "shown" / "trial.png"))[..., ::-1]
  assert shown.shape == (12, 12 * columns, 3)
  step = round(1 / CONTROL_TIMESTEP)
  for column in range(columns):
    robot, simulated = shown[1, 12 * column + 1], shown[10, 12 * column + 10]
    assert robot.tolist() == [100 + step * column] + [step * column] * 2
    assert simulated.tolist() == [step * column] * 3
