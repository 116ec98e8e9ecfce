"""Stages from a capture to localised pictures: keyframes, poses, depth aligned with them.

Each runs, or finds done, one stage of the cache: a function of earlier results and settings.
"""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np

from nerf2real.core.picture_files import write_picture
from nerf2real.core.progress import Progress, part
from nerf2real.core.serialization import write_json
from nerf2real.scenes.capture import keyframes as keyframe_files
from nerf2real.scenes.capture.capture import Capture, CaptureSettings
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.capture.posed import depth_pictures
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses import localisation, structure_from_motion
from nerf2real.scenes.poses.depth import alignment, sensor
from nerf2real.scenes.poses.depth.matched import keep_matches
from nerf2real.scenes.poses.localisation import Localisation, LocalisationError
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.stages.cache import Made, StageResult, Stages
from nerf2real.scenes.stages.results import Source

# 2: stills turned and without copies, depth checked with the pictures, a video's keyframes where
# the picture moves; rgbd 3: depth has its own poses; video 3, rgbd 4, others 3: kept without loss;
# video 4: spread over its frames' times; rgbd 5, others 4: posed pictures as stored, principal
# points of text files by half a pixel
_PICTURES_VERSIONS = {"video": 5, "rgbd": 7}  # 5, 6: colours of HDR and of other profiles; 7: metre
_PICTURES_VERSION = 6  # of all others; 5: colours of other profiles; 6: read by what files hold
# 2: the unit frame's yaw; 3: the rolling shutter is taken out; 4: up by level right axes;
# 5: wrong places found, fainter features; 6: places that came hold what sees little;
# 7: areas of matches are compared, photographs matched with guidance, uncertain ones left out;
# 8: guidance of our own, attempts; 9: the readout with all that it moves;
# 10: the readout is a frame's period at most; points of a COLMAP model are seen by pictures; of few
# pictures some may have no place; 11: photographs without pairs whose rotations contradict;
# 12: by what pictures lack; a film's line is the one that least contradicts; matches are kept of
# what came with depth; 13: uncertain pictures of films are left out, too; 14: patches are aligned;
# 15: a film is held by a hand's motion; 16: what a film's map lacks is placed once more; 17: as 16,
# made anew
_POSES_VERSION = 17
_ALIGNED_VERSION = 2  # 2: sightings in the sensor's metre, as the depth pictures
_MATCHES = "matches.db"  # what pictures with depth show alike
_ALIGNED_RECORD = "aligned.json"  # the factor on the depth's unit
_SENSOR_VERSION = 2  # 2: depth at the pictures' times
_SENSOR_RECORD = "sensor.json"  # what was done to the depth


def keyframes(cache: Stages, source: Source, settings: CaptureSettings) -> Made[Capture]:
  """Takes the sharpest frames of a capture."""

  def write(folder: Path, progress: Progress) -> None:
    taken = read_capture(source.path, folder / "images", settings=settings, progress=progress)
    keyframe_files.save(taken, folder)

  version = _PICTURES_VERSIONS.get(source_kind(source.path), _PICTURES_VERSION)
  inputs = {"source": source.sha256}
  stage = cache.run("keyframes", write, settings=settings, inputs=inputs, version=version)
  return Made(keyframe_files.load(stage.folder, stage.folder / "images"), stage)


def poses(cache: Stages, capture: Made[Capture], settings: LocaliseSettings) -> Made[Localisation]:
  """Estimates the camera, its poses and sparse points by structure from motion."""

  def write(folder: Path, progress: Progress) -> None:
    taken = capture.value
    times = None
    if taken.times is not None:
      times = dict(zip([path.name for path in taken.images], taken.times.tolist(), strict=True))
    names = [path.name for path in taken.images]
    turned = np.zeros(len(names), bool) if taken.turned is None else taken.turned
    try:
      structure_from_motion.localise(
        taken.folder,
        folder,
        settings=settings,
        known=taken.known,
        times=times,
        turned=frozenset(name for name, is_so in zip(names, turned, strict=True) if is_so),
        progress=progress,
      )
    except LocalisationError as error:
      if taken.origins is None or not error.missing:
        raise
      lost = taken.called(np.isin(names, sorted(error.missing)), most=4)
      raise LocalisationError(f"{error} Without a place: {lost}.") from error
    if capture.value.has_depth and (database := folder / "work" / "database.db").is_file():
      keep_matches(database, folder / _MATCHES)
    shutil.rmtree(folder / "work", ignore_errors=True)  # features and matches: large

  inputs = {"keyframes": capture.stamp}
  stage = cache.run("poses", write, settings=settings, inputs=inputs, version=_POSES_VERSION)
  return Made(localisation.load(stage.folder / "sfm"), stage)


def sensed(cache: Stages, capture: Made[Capture], poses: Made[Localisation]) -> Made[Capture]:
  """Returns the capture with measured depth as the pictures' camera would have measured it.

  Where its sensor sits beside that camera, or measured before or after the picture was taken, depth
  is moved.
  """
  known, found = capture.value.known, poses.value
  if known is None or not known.depth_files or not len(found.tracks.view):
    return capture
  of_name = {
    path.name: file for path, file in zip(capture.value.images, known.depth_files, strict=True)
  }

  def write(folder: Path, progress: Progress) -> None:
    depth = np.stack([depth_pictures.read(of_name[name]) for name in found.names])
    moved = None
    if (motion := known.picture_from_depth) is not None:
      rows = [list(of_name).index(name) for name in found.names]
      moved = sensor.at_their_time(
        found, depth, motion[rows], unit=known.depth_unit, progress=part(progress, 0.0, 0.7)
      )
      depth = depth if moved is None else moved
    own = sensor.find_sensor(found, depth, unit=known.depth_unit)
    write_json(folder / _SENSOR_RECORD, {"moved": moved is not None, "beside": own is not None})
    if moved is None and own is None:
      return
    for number, (name, raw) in enumerate(zip(found.names, depth, strict=True)):
      aligned = raw
      if own is not None:
        camera = found.camera.resized(raw.shape[1], raw.shape[0])
        aligned = own.aligned(raw * known.depth_unit, camera) / known.depth_unit
      write_picture(folder / f"{Path(name).stem}.png", np.rint(aligned).astype(np.uint16))
      written = (number + 1) / len(depth)
      progress(0.8 + 0.2 * written, f"depth of picture {number + 1} of {len(depth)} written")

  inputs = {"keyframes": capture.stamp, "poses": poses.stamp}
  stage = cache.run("sensor", write, settings=None, inputs=inputs, version=_SENSOR_VERSION)
  aligned = {path.stem: path for path in stage.folder.glob("*.png")}
  if not aligned:
    return capture
  files = [aligned.get(Path(name).stem, file) for name, file in of_name.items()]
  warnings = list(capture.value.warnings)
  if _is_beside(stage):
    warnings.append(
      "The depth was measured by a camera beside the pictures' own, of another focal length: both "
      "were aligned by localised points."
    )
  still = dataclasses.replace(known, depth_files=tuple(files), depth_poses=known.world_from_camera)
  return Made(dataclasses.replace(capture.value, known=still.lifted(), warnings=warnings), stage)


def _is_beside(stage: StageResult) -> bool:
  """Tells whether a stage's depth was measured by a camera beside the pictures' own."""
  record = stage.folder / _SENSOR_RECORD
  return record.is_file() and bool(json.loads(record.read_text())["beside"])


def aligned(
  cache: Stages, capture: Made[Capture], poses: Made[Localisation]
) -> tuple[Made[Capture], Made[Localisation]]:
  """Returns capture and poses with the pictures laid onto the surfaces that a sensor measured.

  As they are where none did, or one in a place of its own, or where depth and pictures then agree
  no better.
  """
  known, found = capture.value.known, poses.value
  database = poses.stage.folder / _MATCHES
  if known is None or not known.depth_files or not database.is_file() or _is_beside(capture.stage):
    return capture, poses
  of_name = {path.name: row for row, path in enumerate(capture.value.images)}
  rows = [of_name[name] for name in found.names]

  def write(folder: Path, progress: Progress) -> None:
    images = [capture.value.images[row] for row in rows]
    laid = alignment.aligned(
      found, known.selected(rows, known.camera), images, database, progress=progress
    )
    if laid is not None:
      localisation.save(laid[0], laid[1], folder / "sfm")
    write_json(folder / _ALIGNED_RECORD, {"depth_unit": None if laid is None else laid[2]})

  inputs = {"capture": capture.stamp, "poses": poses.stamp}
  stage = cache.run("aligned", write, settings=None, inputs=inputs, version=_ALIGNED_VERSION)
  factor = json.loads((stage.folder / _ALIGNED_RECORD).read_text())["depth_unit"]
  if factor is None:
    return capture, poses
  scaled = dataclasses.replace(
    known, depth_unit=known.depth_unit * factor, sightings=known.sightings * [1, 1, 1, factor]
  )
  moved = dataclasses.replace(capture.value, known=scaled)
  return Made(moved, stage), Made(localisation.load(stage.folder / "sfm"), stage)
