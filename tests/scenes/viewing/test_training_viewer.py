import time

import numpy as np
import pytest

from nerf2real.scenes.field import training
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.poses.tracks import Tracks
from nerf2real.scenes.viewing.training_viewer import TrainingViewer
from tests.scenes import box_views
from tests.scenes.field.test_training import FAST


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
      tracks=Tracks.none(),
    )
  )
  _wait_for(viewer, f"{len(views)} keyframes and 30 points")
  for snapshot in (snapshots[0], snapshots[-1]):
    viewer.field(snapshot)
    _wait_for(viewer, f"Step {snapshot.step:,}")
    assert f"{snapshot.psnr_db:.1f} dB" in viewer.text
