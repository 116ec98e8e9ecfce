"""A made-up model of pictures and points, known exactly."""

import numpy as np
import pycolmap

from nerf2real.scenes.poses.tracks import Tracks

# As of poses that came with the pictures.
NO_TRACKS = Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))


def exact(*, frames: int, points: int) -> pycolmap.Reconstruction:
  """Returns a model of one camera whose pictures see its points where they are."""
  pycolmap.set_random_seed(0)
  return pycolmap.synthesize_dataset(
    pycolmap.SyntheticDatasetOptions(
      num_rigs=1,
      num_cameras_per_rig=1,
      num_frames_per_rig=frames,
      num_points3D=points,
      num_points2D_without_point3D=0,
    )
  )
