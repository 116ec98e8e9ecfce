"""The light on what moves in pictures: Lambert's law, and what is drawn for an episode."""

import numpy as np
import pytest

from nerf2real import suite
from nerf2real.suite.randomisation.draws import NOMINAL, RandomisationSettings, draw_episode
from nerf2real.suite.sensors import light


def test_a_lamp_shines_on_what_faces_it():
  lamp = light.Light(0.3, 0.5, np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.9, 1.1]))
  normals = np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 1.0], [0.0, -0.6, -0.8]])
  expected = np.outer([0.8, 0.7, 0.3], [1.0, 0.9, 1.1])
  assert lamp.on(normals) == pytest.approx(expected)


def test_drawn_lamps_are_above_and_differ():
  rng = np.random.default_rng(0)
  drawn = [light.draw_light(rng) for _ in range(200)]
  directions = np.array([found.direction for found in drawn])
  assert np.linalg.norm(directions, axis=1) == pytest.approx(np.ones(200))
  assert directions[:, 2].min() >= 0.5 - 1e-9 and directions[:, 2].min() < 0.6
  most = np.array([found.ambient + found.lamp for found in drawn])
  assert most.min() < 0.5 and most.max() > 1.5
  assert all(0.3 <= found.ambient <= 0.9 and 0 <= found.lamp <= 0.8 for found in drawn)


def test_drawn_light_leaves_the_other_draws_of_an_episode_as_they_are():
  def draws(**settings):
    return draw_episode(RandomisationSettings(**settings), np.random.default_rng(3))

  fixed, drawn = draws(), draws(light=True)
  assert fixed.light is light.FIXED and draw_episode(NOMINAL, np.random.default_rng(0)).light
  assert np.array_equal(fixed.vector(), drawn.vector())
  assert np.array_equal(fixed.pushes.force, drawn.pushes.force)
  assert drawn.light.ambient != fixed.light.ambient


def test_light_changes_the_ball_and_not_the_room():
  environment = suite.load("ball_push", random=0, randomisation=NOMINAL)
  environment.reset()
  task = environment.task
  state = {
    "position": task.state.position,
    "rotation": task.state.rotation,
    "joints": task.state.joints,
  }
  ahead = task.state.position[:2] + 0.8 * task.state.rotation[:2, 0]
  pictures = []
  for height in (0.12, 40.0):
    task.put_ball(ahead, height=height)
    for shade in (light.FIXED, light.FIXED._replace(ambient=0.9, lamp=0.1)):
      task.robot_camera.set_light(shade)
      pictures.append(task.picture_of(**state).astype(int))
  dim, bright, room, bright_room = pictures
  ball = (dim != room).any(axis=-1)
  assert 30 < ball.sum() < 600
  assert np.array_equal(dim[~ball], bright[~ball]) and np.array_equal(room, bright_room)
  assert bright[ball].sum() > 1.1 * dim[ball].sum()
  environment.close()
