"""Patches of a warped texture, whose places are known exactly."""

import functools

import cv2
import numpy as np
import pycolmap
import pytest

from nerf2real.scenes.poses.matching import patches

SIZE = 320
WARP = np.array([[0.78, 0.11, 25.0], [-0.16, 0.85, 60.0]])  # places of the second picture
SCALE = 2.0  # of the features in the first
PLAIN = 60  # lines of the texture below which it shows nothing
NOISE = 0.7  # of the second picture's features [pixel]


@pytest.fixture
def capture(tmp_path):
  """Two pictures of a texture: model, database, folder, true places in the second one [K, 2]."""
  rng = np.random.default_rng(0)
  texture = cv2.GaussianBlur(rng.uniform(0, 255, (SIZE, SIZE)), (0, 0), 2.0)
  texture = 110 + 60 * (texture - texture.mean()) / texture.std()
  texture[:PLAIN] = 110
  # OpenCV has the first pixel's middle at 0, COLMAP at 0.5.
  moved = WARP.copy()
  moved[:, 2] += WARP[:, :2] @ [0.5, 0.5] - 0.5
  other = 0.8 * cv2.warpAffine(texture, moved, (SIZE, SIZE), flags=cv2.INTER_CUBIC) + 15
  for name, image in (("a.png", texture), ("b.png", other)):
    cv2.imwrite(str(tmp_path / name), np.clip(np.rint(image), 0, 255).astype(np.uint8))
  first = np.stack(np.meshgrid(np.arange(40.0, 290, 25), np.arange(28.0, 290, 29)), -1)
  first = first.reshape(-1, 2) + rng.uniform(-0.5, 0.5, (first.size // 2, 2))
  true = first @ WARP[:, :2].T + WARP[:, 2]
  second = true + np.clip(rng.normal(0, NOISE, true.shape), -2, 2)
  second[-1] = true[-1] + [9.0, -7.0]  # a wrong match
  model = pycolmap.Reconstruction()
  camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 300.0, SIZE, SIZE)
  model.add_camera_with_trivial_rig(camera)
  database = tmp_path / "database.db"
  with pycolmap.Database.open(str(database)) as db:
    db.write_camera(camera, use_camera_id=True)
    shapes = (SCALE * np.eye(2), SCALE * WARP[:, :2])
    for number, (places, shape) in enumerate(zip((first, second), shapes, strict=True), start=1):
      image = pycolmap.Image(
        name=f"{'ab'[number - 1]}.png", keypoints=places, camera_id=1, image_id=number
      )
      db.write_image(image, use_image_id=True)
      keypoints = np.hstack([places, np.tile(shape.ravel(), (len(places), 1))])
      db.write_keypoints(number, keypoints.astype(np.float32))
      model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
  for row in range(len(first)):
    track = pycolmap.Track()
    track.add_element(1, row)
    track.add_element(2, row)
    model.add_point3D(np.array([0.0, 0.0, 1.0]), track, np.zeros(3, np.uint8))
  return model, database, tmp_path, true, first


def test_observations_go_where_the_template_is(capture):
  model, database, folder, true, first = capture
  lost = patches.align(model, database, folder)
  assert {observation.image for observation in lost} == {2}
  kept = np.setdiff1d(np.arange(len(true)), [observation.row for observation in lost])
  found = np.array([place.xy for place in model.images[2].points2D])
  error = np.linalg.norm(found - true, axis=1)
  textured = kept[first[kept, 1] > PLAIN + 20]  # all of their patch
  assert len(textured) > 0.8 * (first[:, 1] > PLAIN + 20).sum()
  assert np.sqrt((error[textured] ** 2).mean()) < 0.05 < 0.1 * NOISE
  assert error[kept].max() < 0.5
  # the templates stay
  np.testing.assert_array_equal([place.xy for place in model.images[1].points2D], first)


def test_what_shows_nothing_and_what_is_elsewhere_is_told(capture):
  model, database, folder, true, first = capture
  before = np.array([place.xy for place in model.images[2].points2D])
  lost = [observation.row for observation in patches.align(model, database, folder)]
  plain = np.flatnonzero(first[:, 1] < PLAIN - 20)
  assert len(plain) and set(plain.tolist()) <= set(lost)
  assert len(true) - 1 in lost
  after = np.array([place.xy for place in model.images[2].points2D])
  np.testing.assert_array_equal(after[lost], before[lost])


def test_a_picture_that_is_gone_is_named(capture):
  model, database, folder, *_ = capture
  (folder / "b.png").unlink()
  with pytest.raises(ValueError, match=r"b\.png cannot be read"):
    patches.align(model, database, folder)


def test_pictures_are_read_few_times_though_few_are_held():
  pairs = [(i, j) for i in range(0, 90, 3) for j in range(0, 90, 3) if i != j]
  rng = np.random.default_rng(0)
  rng.shuffle(pairs)
  order = patches._in_blocks([tuple(pair) for pair in pairs], 5)
  assert sorted(order) == sorted(map(tuple, pairs))
  read = functools.lru_cache(10)(lambda image: image)
  for pair in order:
    for image in pair:
      read(image)
  assert read.cache_info().misses <= 6 * 6 * 10  # of 6 x 6 blocks, each of 5 and 5 pictures
