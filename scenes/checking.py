"""Checks a capture: keyframes, poses and scale only, then a verdict; the scene continues there."""

from pathlib import Path

from nerf2real.core.folder_lock import lock_folder
from nerf2real.scenes.alignment import room_check
from nerf2real.scenes.alignment.world_frame import Alignment, align
from nerf2real.scenes.bundle import STAGES
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.poses.localisation import Localisation, LocalisationError
from nerf2real.scenes.quality import advice
from nerf2real.scenes.settings import SceneSettings
from nerf2real.scenes.source import open_source
from nerf2real.scenes.stages import localising, world_frame
from nerf2real.scenes.stages.cache import Made, StageError, Stages
from nerf2real.scenes.stages.results import Given, Source


def check_capture(
  source: Path,
  out: Path,
  *,
  settings: SceneSettings,
  override: Path | None = None,
  show_progress: bool = True,
) -> advice.Verdict:
  """Judges a capture; what is made for it is cached where `make_scene` finds it.

  Args:
    source: As for `pipeline.make_scene`.
    out: The folder of the bundle that may be made of it.
    settings: Settings of all stages.
    override: As for `pipeline.make_scene`.
    show_progress: Whether to draw progress bars.

  Raises:
    CaptureError: The source cannot become a capture; the message is one line.
    FolderInUseError: Another process makes a scene in the folder.
    ValueError: The folder lies in the capture or holds a scene of another one, or the overrides
      cannot be read.
  """
  out, source = Path(out), Path(source)
  given = Given.read(override, settings.marker_side)
  film = open_source(source, out)
  with lock_folder(out):
    return _judge(film, Stages(out / STAGES, show_progress=show_progress), settings, given)


def _judge(film: Source, cache: Stages, settings: SceneSettings, given: Given) -> advice.Verdict:
  capture = localising.keyframes(cache, film, settings.capture)
  try:
    poses = localising.poses(cache, capture, settings.localise)
  except LocalisationError as error:
    return advice.judge(capture.value, settings.capture, reason=str(error))
  try:
    frame = _world_frame(cache, capture, poses, settings, given)
  except StageError:
    raise
  except ValueError as error:
    return advice.judge(capture.value, settings.capture, poses=poses.value, reason=str(error))
  return advice.judge(capture.value, settings.capture, poses=poses.value, frame=frame)


def _world_frame(
  cache: Stages,
  capture: Made[Capture],
  poses: Made[Localisation],
  settings: SceneSettings,
  given: Given,
) -> Alignment:
  """The world frame as the scene would have it before its training, of the same scale.

  Raises:
    ValueError: There is none; the message is one line.
  """
  found = poses.value
  if given.override.floor_points is None:
    room_check.require_room(found.world_from_camera, found.points)
  outlook = world_frame.outlook(
    cache, capture, poses, settings.align, given, voxel=settings.mesh.voxel
  )
  evidence = world_frame.sparse_evidence(capture.value, found, outlook.value.scale)
  return align(evidence, settings=settings.align, override=given.override)
