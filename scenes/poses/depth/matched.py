"""What pictures with depth show alike: verified matches of features, with the depth measured there.

Shapes: M matches of a pair.
"""

import shutil
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.posed import depth_pictures
from nerf2real.scenes.colmap import pycolmap


class Matched(NamedTuple):
  """Features of one picture, with depth, and where another shows them."""

  first: int
  """Row of the picture with the depth."""
  second: int
  pixel: np.ndarray
  """[M, 2] in the first."""
  depth: np.ndarray
  """z-depth [M] there [m]."""
  seen: np.ndarray
  """[M, 2] in the second."""


def keep_matches(database: Path, kept: Path) -> None:
  """Copies a database without what only matching needs: a twentieth of its size."""
  shutil.copyfile(database, kept)
  connection = sqlite3.connect(kept)
  try:
    for table in ("descriptors", "matches"):
      connection.execute(f"DELETE FROM {table}")
    connection.commit()
    connection.execute("VACUUM")
  finally:
    connection.close()


def read_matches(
  database: Path,
  names: Sequence[str],
  depth_files: Sequence[Path],
  unit: float,
  camera: Camera,
) -> list[Matched]:
  """Returns the verified matches of all pairs, once from either picture; those without depth go.

  Args:
    database: Features and verified matches.
    names: The pictures.
    depth_files: Their depth pictures.
    unit: Of the depth [m].
    camera: Of the pictures.
  """
  with pycolmap.Database.open(str(database)) as db:
    row = {image.image_id: names.index(image.name) for image in db.read_all_images()}
    pixels = {at: np.asarray(db.read_keypoints(key))[:, :2] for key, at in row.items()}
    pairs, verified = db.read_two_view_geometries()
  depth = {
    at: unit * depth_pictures.at_pixels(depth_files[at], pixels[at], camera) for at in row.values()
  }
  found = []
  for pair, geometry in zip(pairs, verified, strict=True):
    ids = [row[key] for key in pycolmap.pair_id_to_image_pair(pair)]
    matches = geometry.inlier_matches.reshape(-1, 2)
    for one, other in ((0, 1), (1, 0)):
      first, second = ids[one], ids[other]
      mine, theirs = matches[:, one], matches[:, other]
      measured = depth[first][mine] > 0
      if measured.any():
        mine, theirs = mine[measured], theirs[measured]
        found.append(
          Matched(first, second, pixels[first][mine], depth[first][mine], pixels[second][theirs])
        )
  return found
