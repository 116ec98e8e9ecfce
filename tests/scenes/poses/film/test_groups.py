"""Tests of a film whose parts stand in two worlds."""

import numpy as np

from nerf2real.scenes.poses.checks.overlap import Overlap
from nerf2real.scenes.poses.film.groups import smaller_group


def seen_of(world: np.ndarray, reach: int = 12) -> Overlap:
  """What pictures have in common within their world: those of as many places elsewhere in a film
  do, and lack it of the other."""
  near = abs(np.subtract.outer(np.arange(len(world)), np.arange(len(world)))) % reach < 4
  same = world == world[:, None]
  return Overlap([*range(len(world))], 9.0 * (near & same), 9.0 * (near & ~same), 0.0)


def test_every_other_part_is_a_group():
  parts = np.repeat(np.arange(6), [12, 9, 12, 9, 12, 9])
  assert (smaller_group(parts, seen_of(parts % 2)) == (parts % 2 == 1)).all()


def test_the_smaller_group_is_that_of_fewer_pictures():
  parts = np.repeat(np.arange(4), [30, 4, 4, 4])
  world = np.array([0, 1, 1, 1])[parts]
  assert (smaller_group(parts, seen_of(world)) == (world == 1)).all()


def test_parts_of_one_world_are_no_groups():
  parts = np.repeat(np.arange(4), 10)
  assert not smaller_group(parts, seen_of(0 * parts)).any()
  assert not smaller_group(0 * parts, seen_of(parts % 2)).any()  # nothing contradicts in the film
  assert len(smaller_group(parts[:0], seen_of(parts[:0]))) == 0


def test_a_small_lack_is_not_clear():
  seen = seen_of(np.zeros(40, int))
  seen.missing[20:23] += 1.0
  parts = np.repeat(np.arange(3), [20, 3, 17])
  assert not smaller_group(parts, seen).any()
