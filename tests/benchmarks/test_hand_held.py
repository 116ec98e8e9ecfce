"""The recording of a hand-held depth camera: its trajectory errs as it says, and has its gap."""

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.rooms import hand_held
from nerf2real.scenes.capture.posed import trajectory


def test_the_trajectory_errs_as_a_tracker_does_and_has_a_gap(tmp_path):
  path = tmp_path / "groundtruth.txt"
  walk = hand_held._walk(0)
  times = hand_held._BEGIN + np.arange(1000) / hand_held._RATE
  hand_held._write_trajectory(path, walk, times, np.random.default_rng(0))
  assert path.read_text().startswith("# ")
  poses, known = trajectory.poses_at(np.loadtxt(path), hand_held._CLOCK + times)
  first, last = hand_held._GAP
  inside = (times > first + trajectory.SAME_TIME) & (times < last - trajectory.SAME_TIME)
  assert inside.sum() > 10 and not known[inside].any() and known[~inside].mean() > 0.99
  true = walk.pose(times[known])
  off = np.linalg.norm(poses[known][:, :3, 3] - true[:, :3, 3], axis=-1)
  turned = Rotation.from_matrix(np.swapaxes(true[:, :3, :3], 1, 2) @ poses[known][:, :3, :3])
  np.testing.assert_allclose(np.sqrt(np.mean(off**2)), 0.01, rtol=0.2)
  np.testing.assert_allclose(np.degrees(np.sqrt(np.mean(turned.magnitude() ** 2))), 0.5, rtol=0.2)
