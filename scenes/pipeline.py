"""Makes a scene bundle from a capture: structure from motion, radiance field, geometry.

Every stage is a function of earlier results and settings and is cached by the hash of both
(`scenes.stages`), so that a second run continues where the first one stopped.
"""

from pathlib import Path

from nerf2real.core.folder_lock import lock_folder
from nerf2real.scenes import assembly, bundle
from nerf2real.scenes.alignment import room_check
from nerf2real.scenes.settings import SceneSettings
from nerf2real.scenes.source import open_source
from nerf2real.scenes.stages import geometry, judging, localising, radiance_field, world_frame
from nerf2real.scenes.stages.cache import Stages
from nerf2real.scenes.stages.pictures import PosedPictures
from nerf2real.scenes.stages.results import Given, Measure, SceneResults, Source, Watcher


def make_scene(
  source: Path,
  out: Path,
  *,
  settings: SceneSettings,
  override: Path | None = None,
  name: str | None = None,
  measure: Measure | None = None,
  show_progress: bool = True,
  watcher: Watcher | None = None,
) -> bundle.Bundle:
  """Makes a scene bundle from a capture.

  Args:
    source: A video, a folder of pictures, a COLMAP model, a transforms.json or an RGB-D sequence
      with poses.
    out: The bundle's folder; stages are cached in it.
    settings: Settings of all stages.
    override: File that fixes what would be found automatically, see `scenes.alignment.overrides`.
    name: The scene's name; that of the output folder if None.
    measure: Adds figures against a known truth.
    show_progress: Whether to draw progress bars.
    watcher: Is shown keyframes, poses and field while they are made, such as `training_viewer`'s.

  Returns:
    The finished bundle.

  Raises:
    FolderInUseError: Another process makes a scene in the folder.
    ValueError: The capture or a setting cannot be used, or the folder lies in the capture or holds
      a scene of another one; the message is one line.
  """
  out, source = Path(out), Path(source)
  given = Given.read(override, settings.marker_side)
  film = open_source(source, out)
  with lock_folder(out):
    return _run_stages(
      film,
      out,
      Stages(out / bundle.STAGES, show_progress=show_progress),
      settings=settings,
      given=given,
      name=name or out.resolve().name,
      measure=measure,
      watcher=watcher,
    )


def _run_stages(
  film: Source,
  out: Path,
  cache: Stages,
  *,
  settings: SceneSettings,
  given: Given,
  name: str,
  measure: Measure | None,
  watcher: Watcher | None,
) -> bundle.Bundle:
  capture = localising.keyframes(cache, film, settings.capture)
  if watcher is not None:
    watcher.keyframes(capture.value)
  poses = localising.poses(cache, capture, settings.localise)
  if watcher is not None:
    watcher.poses(poses.value)
  capture = localising.sensed(cache, capture, poses)
  capture, poses = localising.aligned(cache, capture, poses)
  if given.override.floor_points is None:
    room_check.require_room(poses.value.world_from_camera, poses.value.points)
  outlook = world_frame.outlook(
    cache, capture, poses, settings.align, given, voxel=settings.mesh.voxel
  )
  pictures = PosedPictures(capture, poses, settings.train_width, settings.held_out_every)
  show = None if watcher is None else watcher.field
  points = radiance_field.stereo(cache, pictures, settings.stereo)
  field = radiance_field.field(cache, pictures, points, settings.train, show=show)
  depth = radiance_field.depth(cache, field, capture, poses, width=settings.depth_width)
  figures = judging.figures(cache, field, pictures)
  world = world_frame.world(cache, capture, poses, outlook, depth, settings.align, given)
  rendered = depth.value.transformed(world.value.world_from_unit)
  metric_depth, moved = geometry.corrected(cache, world, rendered, pictures, settings.collision)
  surface = geometry.surface(cache, world, metric_depth, settings.mesh)
  contact = geometry.contact(cache, world, metric_depth, settings.collision, settings.free_space)
  errors = judging.contact_errors(
    cache, world, metric_depth, contact, pictures, top=settings.collision.top
  )
  baseline = judging.baseline(cache, pictures) if settings.baseline == "colmap" else None

  results = SceneResults(
    source=film,
    capture=capture,
    poses=poses,
    pictures=pictures,
    field=field,
    figures=figures,
    world=world,
    depth=metric_depth.value,
    moved=moved,
    surface=surface,
    contact=contact,
    errors=errors,
    baseline=baseline,
  )
  return assembly.assemble(
    results, out, name=name, settings=settings, stages=cache.results, measure=measure
  )
