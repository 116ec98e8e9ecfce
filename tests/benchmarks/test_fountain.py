"""The surveyed photographs' truth, and how poses are compared with it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.rooms import fountain
from nerf2real.core.geometry.similarity import Similarity

FOUNTAIN = Path(__file__).parents[3] / "shared" / "data" / "captures" / "fountain-P11"


def test_another_frame_and_unit_are_no_error():
  if not FOUNTAIN.is_dir():
    pytest.skip("needs ../shared/data/captures/fountain-P11")
  _, truth = fountain.read_truth(FOUNTAIN / "gt_dense_cameras")
  errors = fountain.pose_errors(
    Similarity(0.2, cv2.Rodrigues(np.ones(3))[0]).apply_pose(truth), truth
  )
  assert errors.position_rmse < 1e-9
  assert errors.rotation_rmse < 1e-6
