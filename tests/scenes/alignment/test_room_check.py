"""A room filmed from inside, a thing filmed from around, a facade filmed from one side."""

import numpy as np
import pytest

from nerf2real.scenes.alignment import room_check
from tests.scenes import furnished_room, synthetic_capture


def _ring(first=0.0, last=2 * np.pi, count=50):
  """Cameras 1.2 m around a thing at the origin, at two heights."""
  angles = np.linspace(first, last, count, endpoint=False)
  heights = 0.2 + 0.4 * (np.arange(count) % 2)
  eyes = np.stack([1.2 * np.cos(angles), 1.2 * np.sin(angles), heights], -1)
  return np.array([furnished_room.look_at(eye, [0.0, 0.0, 0.1]) for eye in eyes])


def test_a_thing_from_all_sides_is_no_room():
  thing = np.random.default_rng(0).uniform(-0.3, 0.3, (500, 3))
  with pytest.raises(room_check.NoRoomError, match="50 pictures circle one thing"):
    room_check.require_room(_ring(), thing)


def test_a_room_around_the_ring_is_a_room():
  rng = np.random.default_rng(0)
  walls = rng.uniform(-2.5, 2.5, (500, 3))
  walls[:, 0] = 2.5 * np.sign(walls[:, 0])
  room_check.require_room(_ring(), walls)


def test_a_walk_and_a_facade_are_no_ring():
  rng = np.random.default_rng(0)
  points = rng.uniform([2, 2, 0], [3, 3, 1], (500, 3))
  room_check.require_room(synthetic_capture.walk(30), points)
  room_check.require_room(_ring(0.0, 2.0), rng.uniform(-0.3, 0.3, (500, 3)))
