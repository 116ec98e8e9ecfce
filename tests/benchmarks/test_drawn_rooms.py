"""Tests of the rooms that are drawn: whole, walkable, and the same for the same seed."""

import numpy as np
import pytest

from benchmarks import other_rooms
from benchmarks.drawn_rooms import filming, layout, looks, photographs
from nerf2real.scenes.builtin import camera_path, room, solids
from nerf2real.scenes.builtin.placing import Group
from nerf2real.scenes.capture.media import stills
from nerf2real.scenes.quality import held_out, image_quality


def drawn(seed):
  return layout.draw(np.random.default_rng([seed, 1]))


@pytest.mark.parametrize("seed", range(4))
def test_a_hand_walks_clear_of_things(seed):
  true_room = drawn(seed).room
  random = np.random.default_rng([seed, 4])
  path = camera_path.HandHeld(filming.walk(true_room, filming.rounds(random)), random, seconds=60.0)
  places = path.pose(np.linspace(0, 60, 400))[:, :3, 3]
  assert true_room.distance(places).min() > 0.05
  assert (np.abs(places[:, :2]) < np.array(true_room.size[:2]) / 2).all()
  # It sees the room from both heights.
  assert places[:, 2].min() < 0.7
  assert places[:, 2].max() > 1.3


@pytest.mark.parametrize("seed", [0, 51, 90])
def test_a_lens_shows_something_in_its_corners(seed):
  camera = filming.lens(np.random.default_rng([seed, 4]))
  corners = np.array([[0.0, 0.0], [camera.width, 0.0], [0.0, camera.height]])
  rays = camera.rays(corners)
  np.testing.assert_allclose(camera.project(rays), corners, atol=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_things_are_whole_and_in_the_room(seed):
  found = drawn(seed)
  names = [s.name for s in found.room.solids]
  assert len(set(names)) == len(names)
  half = np.array(found.room.size) / 2
  for solid in found.room.solids:
    if solid.name.startswith("shell"):
      continue
    mesh = solids.tessellate(solid)
    corners = mesh.vertices @ solid.rotation.T + solid.position - [0, 0, half[2]]
    assert (np.abs(corners) < half + 0.02).all(), solid.name
  x, y, _ = found.marker
  assert found.room.distance(np.array([[x, y, 0.2]]))[0] > 0.15  # nothing stands on it


def test_the_same_seed_draws_the_same_room():
  one, again, other = drawn(5), drawn(5), drawn(6)
  assert one.room.size == again.room.size != other.room.size
  assert [s.name for s in one.room.solids] == [s.name for s in again.room.solids]


def test_every_material_is_painted():
  things = drawn(3).room.solids
  painted = looks.paint(things, np.random.default_rng([3, 2]))
  assert {s.material for s in things} <= set(painted)
  assert all(p.dtype == np.uint8 and p.ndim == 3 for p in painted.values())


def test_photographs_are_a_phones_of_one_lens(tmp_path):
  true_room = drawn(1).room
  with filming.seen(true_room, 1) as eye:
    poses = photographs.photograph(tmp_path, true_room, eye, 1, count=3)
  assert true_room.distance(poses[:, :3, 3]).min() > 0.05
  # The third is upright: its sensor's x axis points down.
  assert np.abs(poses[:2, 2, 0]).max() < 0.2 < 0.8 < -poses[2, 2, 0]
  files = stills.list_images(tmp_path)
  assert stills.of_one_camera(files).files == files
  assert stills.read_still(files[0]).shape == (1440, 1920, 3)
  assert stills.read_still(files[2]).shape == (1920, 1440, 3)


def test_a_gain_of_all_pictures_costs_nothing():
  truth = np.random.default_rng(0).integers(20, 120, (4, 6, 8, 3), np.uint8)
  dim = np.rint(truth * np.array([0.5, 0.8, 1.1])).astype(np.uint8)
  views = [
    held_out.ViewScore("", true, seen, np.zeros((6, 8)), image_quality.psnr(seen, true), 1.0)
    for true, seen in zip(truth, dim, strict=True)
  ]
  assert np.mean([view.psnr_db for view in views]) < 22
  assert other_rooms.psnr_with_gain(views) > 45


def test_the_true_free_floor_of_a_room_with_a_wall_across():
  group = Group("wall")
  group.add("box", (0.05, 2.0, 1.0), (1.0, 0.0, 1.0), "white")
  one, apart = other_rooms.true_free_area(room.TrueRoom(tuple(group.solids), (4.0, 4.0, 2.5)))
  # A robot of 0.18 m keeps its middle off the room's ends and the wall.
  assert one == pytest.approx((2.95 - 0.36) * 3.64, rel=0.03)
  assert apart == pytest.approx((0.95 - 0.36) * 3.64, rel=0.06)
