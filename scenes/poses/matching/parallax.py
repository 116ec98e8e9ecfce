"""Measures parallax: matches that one homography explains show rotation, not translation."""

import contextlib
import sqlite3
from pathlib import Path

import cv2
import numpy as np

from nerf2real.scenes.colmap import pycolmap

MIN_MATCHES = 50  # of a pair that is judged
MIN_DISPLACEMENT = 0.05  # median movement of the matches, times the picture's width
MAX_PAIRS = 80  # judged pairs
HOMOGRAPHY_TOLERANCE = 0.004  # reprojection error, times the picture's width: 2.5 of 640 pixels


def parallax_share(database: Path, *, width: int, seed: int = 0) -> float | None:
  """Share of the matches that leave a common homography, median over pairs of pictures.

  A camera that only turns, or that sees one plane only, has 0; a walk through a room 0.2 to 0.6.

  Args:
    database: COLMAP database with verified matches.
    width: Width of the pictures [pixel].
    seed: Of the choice of pairs.

  Returns:
    The share, or None if there are too few pairs.
  """
  with contextlib.closing(sqlite3.connect(database)) as db:
    rows = db.execute(
      "SELECT pair_id FROM two_view_geometries WHERE rows >= ?", (MIN_MATCHES,)
    ).fetchall()
  order = np.random.default_rng(seed).permutation(len(rows))
  shares: list[float] = []
  keypoints: dict[int, np.ndarray] = {}
  with pycolmap.Database.open(str(database)) as db:
    for row in order[: 4 * MAX_PAIRS]:
      first, second = pycolmap.pair_id_to_image_pair(rows[row][0])
      for image_id in (first, second):
        if image_id not in keypoints:
          keypoints[image_id] = db.read_keypoints(image_id)[:, :2].astype(np.float32)
      matches = db.read_two_view_geometry(first, second).inlier_matches
      a, b = keypoints[first][matches[:, 0]], keypoints[second][matches[:, 1]]
      if np.median(np.linalg.norm(a - b, axis=1)) < MIN_DISPLACEMENT * width:
        continue
      _, inside = cv2.findHomography(a, b, cv2.RANSAC, HOMOGRAPHY_TOLERANCE * width)
      if inside is not None:
        shares.append(1 - float(inside.mean()))
      if len(shares) == MAX_PAIRS:
        break
  return float(np.median(shares)) if len(shares) >= 3 else None
