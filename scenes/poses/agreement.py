"""Places pictures anew whose matches disagree with where a mapper put them.

A picture's verified matches lead to points that other pictures see. A wrong place shows there: most
of these points are not where the picture has the match, so that it keeps few of them. A global
mapper, which solves for all positions at once, may leave a few pictures so at a film's ends, all
seeing points of their own. Such pictures, and those without a place, are placed by what the others
see, one after the other, as an incremental mapper does.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.matching.features import image_ids, quiet

MAJORITY = 0.5  # share of the matches that must agree with a place
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


def shares(model: pycolmap.Reconstruction, database: Path) -> dict[int, float]:
  """Returns, for each picture with a place, the share of its matches that agree with it.

  Of its features that are matched to one which sees a point: those that see that point, too.

  Args:
    model: Poses and points.
    database: Its features and verified matches.

  Returns:
    Shares by the pictures' ids; a picture without such features has none.
  """
  sees = {image.image_id: len(image.points2D) for image in mapping.registered(model)}
  asked = {key: np.zeros(count, bool) for key, count in sees.items()}
  agreed = {key: np.zeros(count, bool) for key, count in sees.items()}
  for ids, matches, points in matched_points(model, database):
    for own, other in ((0, 1), (1, 0)):
      theirs = points[:, other] != 0
      asked[ids[own]][matches[theirs, own]] = True
      agreed[ids[own]][matches[theirs & (points[:, own] == points[:, other]), own]] = True
  return {key: agreed[key].sum() / asked[key].sum() for key in sees if asked[key].any()}


def place_again(
  model: pycolmap.Reconstruction,
  database: Path,
  images_folder: Path,
  *,
  seed: int,
  report: Progress = no_progress,
) -> tuple[pycolmap.Reconstruction, int]:
  """Places pictures without a place, and those whose matches disagree with theirs.

  All others and the lens stay as they are.

  Args:
    model: Poses and points.
    database: Its features and verified matches.
    images_folder: Where the pictures lie.
    seed: Of the random choices.
    report: Called with the fraction done and a text.

  Returns:
    A model of at least as many pictures (the same object where none found a better place), and how
    many of them have a new place.
  """
  placed, total = 0, len(image_ids(database))
  for _ in range(_ROUNDS):
    weak = [key for key, share in shares(model, database).items() if share < MAJORITY]
    missing = total - model.num_reg_images()
    if not weak and not missing:
      break
    report(0.0, f"placing {len(weak) + missing} pictures by what the others see")
    found = _continued(model, weak, database, images_folder, seed=seed)
    if found is None or found.num_reg_images() < model.num_reg_images():
      break
    after = shares(found, database)
    better = sum(after.get(key, 0.0) >= MAJORITY for key in weak)
    better += max(0, found.num_reg_images() - model.num_reg_images())
    if not better:
      break
    model, placed = found, placed + better
  return model, placed


def _continued(
  model: pycolmap.Reconstruction,
  weak: list[int],
  database: Path,
  images_folder: Path,
  *,
  seed: int,
) -> pycolmap.Reconstruction | None:
  """Returns a model with all places but those of weak pictures kept, and theirs found anew."""
  kept = pycolmap.Reconstruction(model)
  for key in weak:
    kept.deregister_frame(kept.images[key].frame_id)
  options = mapping.incremental_options(seed)
  options.multiple_models = False
  options.structure_less_registration_fallback = False
  options.fix_existing_frames = True
  options.ba_refine_focal_length = False
  options.ba_refine_extra_params = False
  with tempfile.TemporaryDirectory(dir=database.parent) as folder, quiet():
    begun, ended = Path(folder) / "kept", Path(folder) / "found"
    begun.mkdir()
    ended.mkdir()
    kept.write(str(begun))
    try:
      found = pycolmap.incremental_mapping(
        str(database), str(images_folder), str(ended), options=options, input_path=str(begun)
      )
    except mapping.NOTHING:
      return None
  return max(found.values(), key=lambda m: m.num_reg_images(), default=None)
