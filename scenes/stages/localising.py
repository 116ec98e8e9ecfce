"""Stages from a capture to localised pictures: keyframes, poses.

Each runs, or finds done, one stage of the cache: a function of earlier results and settings.
"""

import shutil
from pathlib import Path

from nerf2real.core.progress import Progress
from nerf2real.scenes.capture import keyframes as keyframe_files
from nerf2real.scenes.capture.capture import Capture, CaptureSettings, read_capture
from nerf2real.scenes.poses import localisation, structure_from_motion
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.stages.cache import Made, Stages
from nerf2real.scenes.stages.results import Source

_POSES_VERSION = 3  # 2: the unit frame's yaw; 3: the rolling shutter is taken out


def keyframes(cache: Stages, source: Source, settings: CaptureSettings) -> Made[Capture]:
  """Takes the sharpest frames of a capture."""

  def write(folder: Path, progress: Progress) -> None:
    taken = read_capture(source.path, folder / "images", settings=settings, progress=progress)
    keyframe_files.save(taken, folder)

  stage = cache.run("keyframes", write, settings=settings, inputs={"source": source.sha256})
  return Made(keyframe_files.load(stage.folder, stage.folder / "images"), stage)


def poses(
  cache: Stages, capture: Made[Capture], settings: structure_from_motion.LocaliseSettings
) -> Made[Localisation]:
  """Estimates the camera, its poses and sparse points by structure from motion."""

  def write(folder: Path, progress: Progress) -> None:
    taken = capture.value
    times = None
    if taken.times is not None:
      times = dict(zip([path.name for path in taken.images], taken.times.tolist(), strict=True))
    structure_from_motion.localise(
      taken.folder, folder, settings=settings, known=taken.known, times=times, progress=progress
    )
    shutil.rmtree(folder / "work", ignore_errors=True)  # features and matches: large

  inputs = {"keyframes": capture.stamp}
  stage = cache.run("poses", write, settings=settings, inputs=inputs, version=_POSES_VERSION)
  return Made(localisation.load(stage.folder / "sfm"), stage)
