"""Checks a capture: keyframes and poses only, then a verdict; making the scene continues there."""

from pathlib import Path

from nerf2real.core.folder_lock import lock_folder
from nerf2real.scenes.bundle import STAGES
from nerf2real.scenes.poses.localisation import LocalisationError
from nerf2real.scenes.quality import advice
from nerf2real.scenes.settings import SceneSettings
from nerf2real.scenes.source import open_source
from nerf2real.scenes.stages import localising
from nerf2real.scenes.stages.cache import Stages
from nerf2real.scenes.stages.results import Source


def check_capture(
  source: Path, out: Path, *, settings: SceneSettings, show_progress: bool = True
) -> advice.Verdict:
  """Judges a capture; keyframes and poses are cached where `make_scene` finds them.

  Args:
    source: As for `pipeline.make_scene`.
    out: The folder of the bundle that may be made of it.
    settings: Settings of all stages.
    show_progress: Whether to draw progress bars.

  Raises:
    CaptureError: The source cannot become a capture; the message is one line.
    FolderInUseError: Another process makes a scene in the folder.
    ValueError: The folder lies in the capture, or holds a scene of another one.
  """
  out, source = Path(out), Path(source)
  film = open_source(source, out)
  with lock_folder(out):
    return _judge(film, Stages(out / STAGES, show_progress=show_progress), settings)


def _judge(film: Source, cache: Stages, settings: SceneSettings) -> advice.Verdict:
  capture = localising.keyframes(cache, film, settings.capture)
  try:
    poses = localising.poses(cache, capture, settings.localise)
  except LocalisationError as error:
    return advice.judge(capture.value, settings.capture, reason=str(error))
  return advice.judge(
    capture.value,
    settings.capture,
    poses=poses.value,
    align=settings.align,
  )
