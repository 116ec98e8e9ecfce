"""Places pictures anew whose matches disagree with where a mapper put them.

A picture's verified matches lead to points that other pictures see. A wrong place shows there: over
most of the picture these points are not where it has the match. Areas are compared, not counts: one
of two paintings that are alike may hold more features than all that is around it, and explains
nothing but itself. A global mapper, which solves for all positions at once, may leave a few
pictures so at a film's ends, all seeing points of their own. Such pictures, and those without a
place, are placed by what the others see, one after the other, as an incremental mapper does; pairs
of pictures that agreed with a wrong place have no say in it.
"""

import shutil
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.matching.features import image_ids, quiet

MAJORITY = 0.5  # share of a picture's matched area, or of a pair's matches, that must agree
_TOLERANCE = 12.0  # pixels between a match and the point it leads to; COLMAP's for a new place
_SIDE = 12  # into so many parts the longer side of a picture is divided, chosen
CELLS = (_SIDE + 1) ** 2  # of a square that holds any picture, its far edges in cells of their own
_ROUNDS = 3  # at most: pictures that were placed well are new witnesses


def matched_points(
  model: pycolmap.Reconstruction, database: Path
) -> Iterator[tuple[tuple[int, int], np.ndarray, np.ndarray]]:
  """Yields what verified matches between pictures with places lead to.

  Args:
    model: Poses and points.
    database: Its features and verified matches.

  Yields:
    The ids of two pictures, the features of their matches [M, 2], and the points that these see
    [M, 2], 0 for none.
  """
  points = {
    image.image_id: np.array([p.point3D_id if p.has_point3D() else 0 for p in image.points2D])
    for image in mapping.registered(model)
  }
  with pycolmap.Database.open(str(database)) as db:
    pairs, verified = db.read_two_view_geometries()
  for pair, geometry in zip(pairs, verified, strict=True):
    ids = pycolmap.pair_id_to_image_pair(pair)
    if all(key in points for key in ids):
      matches = geometry.inlier_matches.reshape(-1, 2)
      seen = np.stack([points[key][matches[:, k]] for k, key in enumerate(ids)], axis=1)
      yield ids, matches, seen


def cells_of(camera: pycolmap.Camera, pixels: np.ndarray) -> np.ndarray:
  """Cells of a grid over a picture in which pixels [M, 2] lie: [M], below `CELLS`, row by row."""
  column, row = (pixels * _SIDE / max(camera.width, camera.height)).astype(np.int64).T
  found: np.ndarray = row * (_SIDE + 1) + column
  return found


class Evidence(NamedTuple):
  """What a picture's matches say of its place; M matches to features that see a point."""

  cells: np.ndarray
  """Cell of a grid in which each of the picture's features lies [F]."""
  features: np.ndarray
  """Of the matches [M]."""
  others: np.ndarray
  """Ids of the pictures that they are matched to [M]."""
  agrees: np.ndarray
  """Whether the point lies where the picture has the feature, bool [M]."""

  @property
  def share(self) -> float:
    """Over what share of the matched area the matches agree: the mean over cells that hold any."""
    asked, agreed = (np.zeros(len(self.cells), bool) for _ in range(2))
    asked[self.features] = True
    agreed[self.features[self.agrees]] = True
    counts = np.bincount(self.cells[asked])
    agreeing = np.bincount(self.cells[agreed], minlength=len(counts))
    return float((agreeing[counts > 0] / counts[counts > 0]).mean())

  def agreeing(self) -> Iterator[int]:
    """Yields the pictures most of whose matches agree."""
    for other in np.unique(self.others):
      if self.agrees[self.others == other].mean() >= MAJORITY:
        yield int(other)


def evidence(model: pycolmap.Reconstruction, database: Path) -> dict[int, Evidence]:
  """Returns what matches say of the places of all pictures that have one, by their ids.

  Args:
    model: Poses and points.
    database: Its features and verified matches.
  """
  images = {image.image_id: image for image in mapping.registered(model)}
  said: dict[int, list[np.ndarray]] = {key: [] for key in images}
  for ids, matches, points in matched_points(model, database):
    for own, other in ((0, 1), (1, 0)):
      seen = points[:, other] != 0
      rows = [matches[seen, own], points[seen, other], np.full(seen.sum(), ids[other])]
      said[ids[own]].append(np.stack(rows).astype(np.int64))
  positions = np.full((max(model.points3D, default=0) + 1, 3), np.nan)
  for number, point in model.points3D.items():
    positions[number] = point.xyz
  found = {}
  for key, parts in said.items():
    features, points, others = np.concatenate([np.zeros((3, 0), np.int64), *parts], axis=1)
    if len(features):
      image = images[key]
      camera = model.cameras[image.camera_id]
      pixels = np.array([point.xy for point in image.points2D])
      local = image.cam_from_world() * positions[points]
      ahead = local[:, 2] > 0
      local[~ahead] = 0, 0, 1
      off = np.linalg.norm(camera.img_from_cam(local) - pixels[features], axis=1)
      found[key] = Evidence(cells_of(camera, pixels), features, others, ahead & (off < _TOLERANCE))
  return found


def place_again(
  model: pycolmap.Reconstruction,
  database: Path,
  images_folder: Path,
  *,
  seed: int,
  misled: Collection[tuple[int, int]] = (),
  report: Progress = no_progress,
) -> tuple[pycolmap.Reconstruction, int]:
  """Places pictures without a place, and those whose matches disagree with theirs.

  All others and the lens stay as they are. A picture with which no place agrees better keeps its
  own.

  Args:
    model: Poses and points.
    database: Its features and verified matches.
    images_folder: Where the pictures lie.
    seed: Of the random choices.
    misled: Pairs that agreed with a wrong place, of which the first has none any more.
    report: Called with the fraction done and a text.

  Returns:
    A model of at least as many pictures (the same object where none found a better place), and how
    many of them have a new place.
  """
  total = len(image_ids(database))
  moved: set[int] = set()
  staying: set[int] = set()
  misled = set(misled)
  for _ in range(_ROUNDS):
    judged = evidence(model, database)
    weak = {key for key, said in judged.items() if said.share < MAJORITY} - staying
    missing = total - model.num_reg_images()
    while weak or missing:
      report(0.0, f"placing {len(weak) + missing} pictures by what the others see")
      refuted = {(key, one) for key in weak for one in judged[key].agreeing() if one not in weak}
      kept = pycolmap.Reconstruction(model)
      for key in weak:
        kept.deregister_frame(kept.images[key].frame_id)
      found = _continued(kept, misled | refuted, database, images_folder, seed=seed)
      again = evidence(found, database)
      new = _placed(found) - _placed(kept)
      least = {key: judged[key].share if key in weak else MAJORITY for key in new}
      better = {key for key in new if key not in again or again[key].share >= least[key]}
      if weak <= better:
        break
      staying |= weak - better  # the others are placed once more, beside what these see
      weak &= better
    else:
      break
    for key in new - better:
      found.deregister_frame(found.images[key].frame_id)
    if not better:
      break
    model, misled = found, misled | refuted
    moved |= better
  return model, len(moved)


def _placed(model: pycolmap.Reconstruction) -> set[int]:
  return {image.image_id for image in mapping.registered(model)}


def _continued(
  kept: pycolmap.Reconstruction,
  without: Collection[tuple[int, int]],
  database: Path,
  images_folder: Path,
  *,
  seed: int,
) -> pycolmap.Reconstruction:
  """Returns a model with all that can be placed without some pairs' matches, and what it has."""
  options = mapping.incremental_options(seed)
  options.multiple_models = False
  options.structure_less_registration_fallback = False
  options.fix_existing_frames = True
  options.ba_refine_focal_length = False
  options.ba_refine_extra_params = False
  placed = _placed(kept)
  pairs = [pair for pair in without if pair[0] not in placed]
  with tempfile.TemporaryDirectory(dir=database.parent) as folder, quiet():
    begun, ended = Path(folder) / "kept", Path(folder) / "found"
    begun.mkdir()
    ended.mkdir()
    kept.write(str(begun))
    if pairs:
      database = Path(shutil.copyfile(database, Path(folder) / "database.db"))
      with pycolmap.Database.open(str(database)) as db:
        for pair in pairs:
          db.delete_two_view_geometry(*pair)
    try:
      found = pycolmap.incremental_mapping(
        str(database), str(images_folder), str(ended), options=options, input_path=str(begun)
      )
    except mapping.NOTHING:
      return kept
  return max([kept, *found.values()], key=lambda m: m.num_reg_images())
