"""Measures parallax: matches that a turn of the camera explains do not show that it moved.

A homography explains more: in a room with plain walls the matches of two photographs may lie on one
plane, such as the floor, wherever they were taken from.
"""

import contextlib
import sqlite3
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.scenes.colmap import pycolmap

MIN_MATCHES = 50  # of a pair that is judged
MIN_DISPLACEMENT = 0.05  # median movement of the matches, times the picture's width
MAX_PAIRS = 80  # judged pairs
TOLERANCE = 0.004  # reprojection error, times the picture's width: 2.5 of 640 pixels
_FOCALS = np.geomspace(0.4, 4.0, 25)  # times the picture's width: wide-angle lenses to long ones


def parallax_share(database: Path, *, seed: int = 0) -> float | None:
  """Share of the matches that no turn of the camera explains, median over pairs of pictures.

  A camera that only turns has 0; films of three rooms have 0.8 to 1.

  Args:
    database: COLMAP database with verified matches.
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
    camera = db.read_all_cameras()[0]  # all pictures are of one
    width, middle = camera.width, 0.5 * np.array([camera.width, camera.height])
    for row in order[: 4 * MAX_PAIRS]:
      first, second = pycolmap.pair_id_to_image_pair(rows[row][0])
      for image_id in (first, second):
        if image_id not in keypoints:
          keypoints[image_id] = db.read_keypoints(image_id)[:, :2].astype(np.float32)
      matches = db.read_two_view_geometry(first, second).inlier_matches
      a, b = keypoints[first][matches[:, 0]], keypoints[second][matches[:, 1]]
      if np.median(np.linalg.norm(a - b, axis=1)) < MIN_DISPLACEMENT * width:
        continue
      _, inside = cv2.findHomography(a, b, cv2.RANSAC, TOLERANCE * width)
      if inside is not None:
        turned = _turned((a - middle) / width, (b - middle) / width, inside.ravel() > 0)
        shares.append(1 - turned)
      if len(shares) == MAX_PAIRS:
        break
  return float(np.median(shares)) if len(shares) >= 3 else None


def _turned(first: np.ndarray, second: np.ndarray, common: np.ndarray) -> float:
  """Share of matches that one turn explains, at the focal length for which it explains most.

  Args:
    first: Places in a picture from its centre [M, 2], times its width.
    second: Places in the other [M, 2].
    common: Matches of one homography, bool [M]: the turn is fitted to them.
  """
  best = 0.0
  for focal in _FOCALS:
    a, b = (np.insert(x / focal, 2, 1.0, axis=1) for x in (first, second))
    ways = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b)]
    turn = Rotation.align_vectors(ways[1][common], ways[0][common])[0].apply(a)
    ahead = np.maximum(turn[:, 2:], 1e-6)
    error = np.linalg.norm(focal * (turn[:, :2] / ahead - b[:, :2]), axis=1)
    best = max(best, float((error < TOLERANCE).mean()))
  return best
