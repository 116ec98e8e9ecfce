"""Extracts and matches features into a COLMAP database that survives interruption.

Every call does only what the database does not hold yet.
"""

import contextlib
import copy
import dataclasses
import os
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.matching import guided
from nerf2real.scenes.poses.matching.pairs import Pair, PairSettings, choose_pairs, overlap_scores

_EXTRACTION_CHUNK = 8  # pictures between two progress reports
_MATCHING_CHUNK = 300  # pairs between two progress reports
_FATAL_ONLY = 3  # glog level


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureSettings:
  """Features and their matching."""

  max_num_features: int = 1536
  """Of each of many pictures, the largest first; time grows with the square."""
  few_num_features: int = 4096
  """Of each of few pictures; between, as many as the cost of all their pairs allows."""
  max_image_size: int = 1600
  """Long side at which features are sought [pixel]."""
  faint_below: int = 512
  """A picture with fewer features is searched again for fainter ones: plain walls."""
  faint_peak: float = 0.002
  """What a spot then must differ by from its surroundings, of white; COLMAP asks for 0.0067."""
  affine_shape: bool = True
  """Paper, appendix A."""
  guided_matching: bool = True
  """Paper, appendix A."""
  most_products: float = 1e10
  """Products of feature counts that all pairs of pictures may have before each is given fewer
  features. Measured: 0.4e-8 s of processor time each."""
  focal_factor: float = 1.2
  """First guess of the focal length, times the long side; COLMAP."""

  def of_each(self, pictures: int) -> int:
    """Features of each picture, so that matching all pairs costs no more than it may."""
    allowed = np.sqrt(self.most_products / max(pictures * (pictures - 1) / 2, 1))
    return int(np.clip(allowed, self.max_num_features, self.few_num_features))


@contextlib.contextmanager
def quiet() -> Iterator[None]:
  """Silences COLMAP's log on the terminal; its errors still arrive as exceptions."""
  log = pycolmap.logging
  before = log.minloglevel, log.stderrthreshold, log.logtostderr, log.alsologtostderr
  log.minloglevel, log.stderrthreshold = _FATAL_ONLY, _FATAL_ONLY
  log.logtostderr = log.alsologtostderr = False
  try:
    yield
  finally:
    log.minloglevel, log.stderrthreshold, log.logtostderr, log.alsologtostderr = before


def image_ids(database: Path) -> dict[str, int]:
  """Returns the database's picture ids by name, in order of the names."""
  with pycolmap.Database.open(str(database)) as db:
    return {i.name: i.image_id for i in sorted(db.read_all_images(), key=lambda i: i.name)}


def _with_features(database: Path) -> set[str]:
  """Names of the pictures whose features are complete."""
  if not database.is_file():
    return set()
  with contextlib.closing(sqlite3.connect(database)) as db:
    rows = db.execute(
      "SELECT name FROM images JOIN keypoints USING (image_id) JOIN descriptors USING (image_id)"
    )
    return {row[0] for row in rows}


def extract_features(
  database: Path,
  images_folder: Path,
  names: list[str],
  *,
  settings: FeatureSettings,
  camera: pycolmap.Camera | None = None,
  report: Progress = no_progress,
) -> None:
  """Finds affine-shape SIFT features of pictures that share one OPENCV camera.

  Args:
    database: Created if absent.
    images_folder: Where the pictures lie.
    names: The pictures.
    settings: Of the features.
    camera: Known intrinsics; a first guess from the picture size if None.
    report: Called with the fraction done and a text.
  """
  reader = pycolmap.ImageReaderOptions()
  reader.camera_model = "OPENCV"
  reader.default_focal_length_factor = settings.focal_factor
  if camera is not None:
    reader.camera_params = ",".join(repr(float(value)) for value in camera.params)
  options = pycolmap.FeatureExtractionOptions()
  options.max_image_size = settings.max_image_size
  options.num_threads = os.cpu_count() or 1
  options.sift.estimate_affine_shape = settings.affine_shape
  options.sift.max_num_features = settings.of_each(len(names))
  faint = copy.deepcopy(options)
  faint.sift.max_num_features = min(settings.faint_below, options.sift.max_num_features)
  faint.sift.peak_threshold = settings.faint_peak

  def extract(chosen: list[str], how: pycolmap.FeatureExtractionOptions) -> None:
    if database.is_file():
      with pycolmap.Database.open(str(database)) as db:
        cameras = db.read_all_cameras()
      if cameras:  # a later call would make a second camera
        reader.existing_camera_id = cameras[0].camera_id
    with quiet():
      pycolmap.extract_features(
        str(database),
        str(images_folder),
        chosen,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=how,
        device=pycolmap.Device.cpu,
      )

  done = _with_features(database)
  missing = [name for name in names if name not in done]
  for first in range(0, len(missing), _EXTRACTION_CHUNK):
    chunk = missing[first : first + _EXTRACTION_CHUNK]
    extract(chunk, options)
    count = dict(zip(sorted(image_ids(database)), feature_counts(database), strict=True))
    few = [name for name in chunk if count[name] < faint.sift.max_num_features]
    if few:
      _forget_features(database, few)
      extract(few, faint)
    found = min(first + _EXTRACTION_CHUNK, len(missing))
    report(found / len(missing), f"features of {found + len(done)} of {len(names)} pictures")


def _forget_features(database: Path, names: list[str]) -> None:
  """Deletes the features of pictures, which stay."""
  ids = image_ids(database)
  rows = [(ids[name],) for name in names]
  with contextlib.closing(sqlite3.connect(database)) as db, db:
    for table in ("keypoints", "descriptors"):
      db.executemany(f"DELETE FROM {table} WHERE image_id = ?", rows)


def feature_counts(database: Path) -> np.ndarray:
  """Number of features of every picture [N], in order of the names."""
  with contextlib.closing(sqlite3.connect(database)) as db:
    rows = db.execute(
      "SELECT COALESCE(keypoints.rows, 0) FROM images LEFT JOIN keypoints USING (image_id) "
      "ORDER BY name"
    )
    return np.array([row[0] for row in rows], np.int64)


def largest_descriptors(database: Path, ids: list[int], count: int) -> np.ndarray:
  """Descriptors of the features of the largest area, of length 1: float32 [N, count, 128]."""
  result = np.zeros((len(ids), count, 128), np.float32)
  with pycolmap.Database.open(str(database)) as db:
    for row, image_id in enumerate(ids):
      keypoints = db.read_keypoints(image_id)  # x, y and the affine shape a11, a12, a21, a22
      if len(keypoints) == 0:
        continue
      descriptors = db.read_descriptors(image_id).data.astype(np.float32)
      area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
      kept = descriptors[np.argsort(-area, kind="stable")[:count]]
      result[row, : len(kept)] = kept / np.linalg.norm(kept, axis=1, keepdims=True)
  return result


def find_pairs(
  database: Path, settings: PairSettings, *, report: Progress = no_progress
) -> tuple[list[Pair], str]:
  """Chooses which pictures of the database to match: see `scenes.poses.matching.pairs`."""
  ids = list(image_ids(database).values())

  def score(keyframes: np.ndarray) -> np.ndarray:
    descriptors = largest_descriptors(
      database, [ids[i] for i in keyframes], settings.score_features
    )
    return overlap_scores(
      descriptors,
      ratio=settings.score_ratio,
      progress=report,
    )

  return choose_pairs(feature_counts(database), settings, score=score)


def matched_pairs(database: Path) -> set[Pair]:
  """Pairs of picture ids that were matched and verified, found overlapping or not."""
  with contextlib.closing(sqlite3.connect(database)) as db:
    rows = db.execute("SELECT pair_id FROM two_view_geometries").fetchall()
  pairs = (pycolmap.pair_id_to_image_pair(row[0]) for row in rows)
  return {(min(a, b), max(a, b)) for a, b in pairs}


def match_pairs(
  database: Path,
  pairs: list[Pair],
  *,
  settings: FeatureSettings,
  seed: int,
  report: Progress = no_progress,
) -> int:
  """Matches and verifies pairs, given as indices into the sorted names.

  Args:
    database: Features, and matches of earlier calls.
    pairs: Which pictures.
    settings: How features are matched.
    seed: Of RANSAC.
    report: Called with the fraction done and a text.

  Returns:
    The number of pairs that were matched.
  """
  ids = image_ids(database)
  names = list(ids)
  numbers = list(ids.values())
  done = matched_pairs(database)
  wanted = {(i, j): (min(numbers[i], numbers[j]), max(numbers[i], numbers[j])) for i, j in pairs}
  missing = [pair for pair in sorted(wanted) if wanted[pair] not in done]
  if settings.guided_matching:  # what a run that was interrupted has left
    guided.match_pairs(database, sorted(done & set(wanted.values())))
  options = pycolmap.FeatureMatchingOptions()
  options.num_threads = os.cpu_count() or 1
  verification = pycolmap.TwoViewGeometryOptions()
  verification.ransac.random_seed = seed
  with tempfile.TemporaryDirectory() as folder:
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = os.path.join(folder, "pairs.txt")
    for first in range(0, len(missing), _MATCHING_CHUNK):
      chunk = missing[first : first + _MATCHING_CHUNK]
      lines = (f"{names[i]} {names[j]}\n" for i, j in chunk)
      Path(pairing.match_list_path).write_text("".join(lines))
      with quiet():
        pycolmap.match_image_pairs(
          str(database),
          matching_options=options,
          pairing_options=pairing,
          verification_options=verification,
          device=pycolmap.Device.cpu,
        )
      if settings.guided_matching:
        guided.match_pairs(database, [wanted[pair] for pair in chunk])
      found = min(first + _MATCHING_CHUNK, len(missing))
      report(found / len(missing), f"matched {found} of {len(missing)} pairs")
  return len(missing)
