import time

import cv2
import numpy as np
import pytest

from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.field import training
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.viewing.training_viewer import TrainingViewer, sheet
from tests.scenes import box_views
from tests.scenes.field.test_training import FAST
from tests.scenes.synthetic_model import NO_TRACKS


@pytest.fixture
def viewer():
  found = TrainingViewer(host="127.0.0.1", port=0)
  yield found
  found.close()


@pytest.fixture(scope="module")
def views():
  return box_views.make_views(12, width=32, height=24)


@pytest.fixture(scope="module")
def snapshots(views):
  seen = []
  training.train(views, FAST, show=seen.append, show_period=0.0)
  return seen


def _wait_for(viewer, text):
  end = time.monotonic() + 60
  while text not in viewer.text:
    assert time.monotonic() < end, viewer.text
    time.sleep(0.05)


def test_training_hands_out_fields_that_get_better(snapshots):
  assert [s.step for s in snapshots] == sorted({s.step for s in snapshots})
  assert snapshots[-1].psnr_db > snapshots[0].psnr_db + 3
  assert snapshots[-1].seconds_left < snapshots[len(snapshots) // 2].seconds_left
  first, last = snapshots[0].field.params, snapshots[-1].field.params
  assert all((first[name] != last[name]).any() for name in first)


def _capture(folder, count):
  """Keyframes of 64x48 pixels, each a little redder than the one before."""
  images = [folder / f"frame_{k:06d}.png" for k in range(count)]
  for k, path in enumerate(images):
    cv2.imwrite(str(path), np.full((48, 64, 3), (0, 0, 10 * k), np.uint8))
  ones = np.ones(count)
  return Capture("video", folder, images, 64, 48, ones, ones, ones, None, [])


def test_keyframes_are_shown_in_the_order_of_the_film(viewer, tmp_path):
  drawn = sheet(_capture(tmp_path, 22))
  assert drawn.shape == (5 * 120, 3 * 160, 3)
  reds = drawn[60::120, 80::160, 0].ravel().astype(int)
  assert reds[0] == 0 and reds[-1] == 210 and (np.diff(reds) > 0).all()
  few = sheet(_capture(tmp_path, 4))
  assert (few[60, 80::160, 0] == [0, 10, 20]).all() and (few[180, 240] == 255).all()
  viewer.keyframes(_capture(tmp_path, 4))
  _wait_for(viewer, "4 keyframes. Their poses")


def test_the_page_shows_points_then_the_newest_field(viewer, snapshots, views):
  assert "Keyframes" in viewer.text
  points = np.random.default_rng(0).normal(size=(30, 3))
  viewer.poses(
    Localisation(
      camera=views.camera,
      names=views.names,
      world_from_camera=views.world_from_camera,
      points=points,
      point_colors=np.full((30, 3), 200, np.uint8),
      point_errors=np.ones(30),
      reprojection_error_px=1.0,
      registered_fraction=1.0,
      strategy="none",
      unit_from_source=None,
      tracks=NO_TRACKS,
    )
  )
  _wait_for(viewer, f"{len(views)} keyframes and 30 points")
  for snapshot in (snapshots[0], snapshots[-1]):
    viewer.field(snapshot)
    assert f"Step {snapshot.step:,}" in viewer.text
    assert f"{snapshot.psnr_db:.1f} dB" in viewer.text


def test_a_field_that_nobody_looks_at_is_not_drawn(viewer, snapshots, monkeypatch):
  drawn = []
  monkeypatch.setattr(viewer, "_show", drawn.append)
  for snapshot in snapshots:
    viewer.field(snapshot)
  time.sleep(0.2)
  assert not drawn
  monkeypatch.setattr(viewer._server, "get_clients", lambda: {1: None})
  viewer._wake()  # as a browser does that opens the page
  end = time.monotonic() + 60
  while not drawn:
    assert time.monotonic() < end
    time.sleep(0.05)
  assert drawn == [snapshots[-1]]  # older ones that waited are dropped
  monkeypatch.undo()
  viewer._show(snapshots[0])
  viewer._show(snapshots[-1])
  assert viewer._view is not None
