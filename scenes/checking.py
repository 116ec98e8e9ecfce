"""Checks a capture: keyframes and poses only, then a verdict; making the scene continues there."""

from pathlib import Path

from nerf2real.core import files
from nerf2real.scenes.bundle import STAGES
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.poses.localisation import LocalisationError
from nerf2real.scenes.quality import advice
from nerf2real.scenes.settings import SceneSettings
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
  """
  out, source = Path(out), Path(source)
  source_kind(source)  # raises where it cannot be used
  film = Source(source, files.hash_path(source))
  cache = Stages(out / STAGES, show_progress=show_progress)
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
