"""Localises keyframes by structure from motion: one camera, poses, points in the unit frame.

`localise` leaves `sfm/` (a COLMAP model in the unit frame, and `localisation.json`); features and
matches stay in `work/database.db`, so that an interrupted run continues. Shapes: N registered
keyframes, P points.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nerf2real.core.errors import first_few
from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.scenes.capture.media.stills import list_images, upright_poses
from nerf2real.scenes.capture.posed.colmap_model import camera_of, to_colmap
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping, sharpening
from nerf2real.scenes.poses.best_model import best_model, sees_more
from nerf2real.scenes.poses.checks import certainty, things_alike
from nerf2real.scenes.poses.checks.registered import check_registered, needed
from nerf2real.scenes.poses.depth import refinement
from nerf2real.scenes.poses.film import completion, continuity, motion_prior, readout
from nerf2real.scenes.poses.localisation import (
  Localisation,
  LocalisationError,
  from_model,
  poses_of,
  reprojection_error,
  save,
)
from nerf2real.scenes.poses.matching import features
from nerf2real.scenes.poses.matching.pairs import repair_pairs
from nerf2real.scenes.poses.matching.parallax import parallax_share
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.unit_frame import unit_from_source as choose_unit_frame
from nerf2real.scenes.poses.work import KNOWN_SHARES, Mapped, Steps, prepare_work

_MODEL_FOLDER, _WORK_FOLDER = "sfm", "work"
_NAMED = 6  # pictures in a warning


def localise(
  images_folder: Path,
  out_folder: Path,
  *,
  settings: LocaliseSettings | None = None,
  known: KnownPoses | None = None,
  times: Mapping[str, float] | None = None,
  turned: frozenset[str] = frozenset(),
  progress: Progress = no_progress,
) -> Localisation:
  """Localises the pictures of a folder.

  Args:
    images_folder: Keyframes of one camera.
    out_folder: Receives `sfm/` and `work/`.
    settings: How.
    known: Poses that came with the pictures, in the order of their sorted names. Metric ones are
      adjusted to the pictures where `settings.refine_known` is set; all others are kept, and points
      are triangulated with them.
    times: When each picture of a film was taken [s]: its rolling shutter is taken out. Names end in
      the frames' numbers.
    turned: Pictures that were turned counter-clockwise by a quarter.
    progress: Called with the fraction done and a text.

  Raises:
    LocalisationError: If too few keyframes can be localised.
  """
  settings = settings or LocaliseSettings()
  images_folder, out_folder = Path(images_folder), Path(out_folder)
  names = [path.name for path in list_images(images_folder)]
  if not names:
    raise LocalisationError(f"{images_folder} holds no pictures.")
  if known is not None and len(known.world_from_camera) != len(names):
    raise LocalisationError(
      f"{len(known.world_from_camera)} known poses for {len(names)} pictures: expected one each."
    )
  steps = Steps(progress)
  refined = None
  if known is not None and known.is_metric and settings.refine_known:
    few = Steps(progress, KNOWN_SHARES)
    refined = refinement.localise_known(
      images_folder, out_folder / _WORK_FOLDER, names, settings, known, few
    )
  if refined is not None:
    result, steps = refined, few
  elif known is not None and known.is_metric:
    result = _as_it_came(known, names)
  else:
    database = prepare_work(images_folder, out_folder / _WORK_FOLDER, names, settings, known)
    result = _map(database, images_folder, names, settings, known, steps, times)
    if known is None:
      result = _aligned(result, database, images_folder, steps)
      if times is not None:
        result = _without_shutter(result, times, steps)
      result = _settled(result, steps)
    if known is not None and not result.model.num_points3D():
      result = _as_it_came(known, names)
  localisation = _describe(result, len(names), known, images_folder, turned, steps)
  save(result.model, localisation, out_folder / _MODEL_FOLDER)
  return localisation


def _as_it_came(known: KnownPoses, names: list[str]) -> Mapped:
  """The poses and points that came with the pictures; no picture sees a point."""
  model = mapping.model_from_poses(known, names)
  for point, error in zip(model.points3D.values(), known.point_errors, strict=True):
    point.error = error
  return Mapped(model, f"poses and points of the {known.kind} source", ())


def _map(
  database: Path,
  images_folder: Path,
  names: list[str],
  settings: LocaliseSettings,
  known: KnownPoses | None,
  steps: Steps,
  times: Mapping[str, float] | None,
) -> Mapped:
  """Features, pairs, matches, a model, repairs, refinement."""
  film = times is not None
  steps.begin("features")
  features.extract_features(
    database,
    images_folder,
    names,
    settings=settings.features,
    report=steps.report,
    camera=None if known is None else to_colmap(known.camera),
  )
  steps.begin("matching")
  pairs, words = features.find_pairs(database, settings.pairs, report=steps.report)

  def match(chosen: list[tuple[int, int]]) -> int:
    return features.match_pairs(
      database, chosen, settings=settings.features, seed=settings.seed, report=steps.report
    )

  match(pairs)
  warnings = []
  share = parallax_share(database, seed=settings.seed)
  if share is not None and share < settings.min_parallax:
    warnings.append(
      f"Hardly any parallax: {1 - share:.0%} of the matches fit a camera that only turns; walk "
      "sideways and through the room instead of turning on the spot."
    )
  steps.begin("mapping")
  if known is not None:
    fixed = mapping.triangulate(database, images_folder, known, names)
    return Mapped(fixed, f"{words} matching, triangulated with known poses", tuple(warnings))
  model, mapper, apart, out = best_model(
    database, images_folder, len(names), settings, steps, times
  )
  if model is None or model.num_reg_images() < settings.repair_below * len(names):
    placed = {i.name for i in mapping.registered(model)} if model else set()
    missing = [row for row, name in enumerate(names) if name not in placed]
    steps.begin("matching")
    added = match(
      repair_pairs(
        missing,
        len(names),
        overlap=settings.pairs.overlap,
        loop_keyframes=settings.pairs.loop_keyframes,
      )
    )
    if added:
      steps.begin("mapping")
      again = best_model(database, images_folder, len(names), settings, steps, times)
      if sees_more(again.model, model):
        model, mapper, apart, out = again
        words += f", repaired with {added} pairs of {len(missing)} keyframes that had no place"
  check_registered(model, names, settings, share, film=film)
  assert model is not None  # for the type checker: check_registered has raised
  alike: list[str] = []
  if not film:
    steps.begin("mapping")

    def map_again(database: Path) -> tuple[pycolmap.Reconstruction | None, str, float]:
      return best_model(database, images_folder, len(names), settings, steps, times)[:3]

    found = things_alike.Found(model, mapper, apart)
    model, mapper, apart = things_alike.undeceived(found, database, map_again, seed=settings.seed)
    alike = things_alike.doubtful(model)
  if apart > settings.max_apart:
    weakest = min(mapping.registered(model), key=lambda image: image.num_points3D)
    warnings.append(
      f"Parts of the capture hang together by little: attempts to place the pictures differ by up "
      f"to {apart:.0%} of the room's width. {weakest.name} sees fewest points "
      f"({weakest.num_points3D}): take more pictures there, slowly and with more in view."
    )
  if alike:
    warnings.append(
      f"Things that look alike: {first_few(alike, _NAMED)} do not show most of what others "
      "show that stand as close to it, so that they may be placed before the wrong one of two: "
      "cover one of the two, and take those of both anew."
    )
  if times is not None:
    steps.begin("holding")
    model = motion_prior.hold(model, database, times, report=part(steps.report, 0.0, 0.7))
    model, lost = completion.complete(
      model, database, images_folder, times, seed=settings.seed, report=part(steps.report, 0.7, 1.0)
    )
    out |= lost
  steps.begin("refining")
  model, lens = mapping.refine(model, report=steps.report)
  dropped = mapping.drop_weak_images(model)
  least = needed(len(names), settings)
  uncertain, kept = certainty.drop_uncertain(model, least=least)
  out |= frozenset(uncertain)
  if kept:
    warnings.append(
      f"Uncertain: the places of {', '.join(kept)} hang on little. They are used, as fewer than "
      f"{least} pictures would be left: take more in between."
    )
  if dropped or uncertain:
    check_registered(model, names, settings, share, film=film)
  placed = {image.name for image in mapping.registered(model)}
  out -= placed
  if times is not None and out:
    warnings.append(continuity.gaps(out, placed, times))
  if not lens.principal:
    warnings.append(f"Lens: estimated {lens.words}.")
  strategy = f"{words}, {mapper}; lens: {lens.words}"
  return Mapped(model, strategy, tuple(warnings), lens, left_out=tuple(sorted(out)))


def _aligned(mapped: Mapped, database: Path, images_folder: Path, steps: Steps) -> Mapped:
  """Aligns the patches that a model's points show."""
  steps.begin("aligning")
  return dataclasses.replace(
    mapped, model=sharpening.align(mapped.model, database, images_folder, report=steps.report)
  )


def _settled(mapped: Mapped, steps: Steps) -> Mapped:
  """Adjusts an aligned model by the noise that is left."""
  assert mapped.lens is not None  # for the type checker: only known poses have none
  steps.begin("settling")
  return dataclasses.replace(
    mapped, model=sharpening.settle(mapped.model, mapped.lens, report=steps.report)
  )


def _without_shutter(mapped: Mapped, times: Mapping[str, float], steps: Steps) -> Mapped:
  """Takes the rolling shutter out of a model.

  The model itself where that spoils the lens, of a film without times, which tells no speed, and of
  one whose keyframes lie too far apart.
  """
  period = readout.frame_period(times)
  if period is None:
    words = f"{mapped.strategy}; rolling shutter not taken out, because the film has no times"
    return dataclasses.replace(mapped, strategy=words)
  if not readout.tells_motion(mapped.model, times):
    warnings = (*mapped.warnings, readout.TOO_FAR_APART)
    words = f"{mapped.strategy}; rolling shutter not taken out, because keyframes lie too far apart"
    return dataclasses.replace(mapped, strategy=words, warnings=warnings)
  lens = mapped.lens
  assert lens is not None  # for the type checker: only known poses have none
  steps.begin("shutter")
  model, found = readout.take_out(
    mapped.model,
    times,
    longest=period,
    principal=lens.principal,
    distortion=lens.distortion,
    report=steps.report,
  )
  mapping.drop_bad_observations(model)
  fault = mapping.camera_fault(camera_of(model))
  if fault is not None:
    words = f"{mapped.strategy}; rolling shutter not taken out, because {fault}"
    return dataclasses.replace(mapped, strategy=words)
  placed = [image.name for image in mapping.registered(model)]
  if mapping.drop_weak_images(model):
    kept = {image.name for image in mapping.registered(model)}
    found = found.of(np.array([name in kept for name in placed]))
  words = f"{mapped.strategy}; rolling shutter of {1e3 * found.readout:.1f} ms taken out"
  doubt = readout.doubt(found.readout, period)
  warnings = mapped.warnings if doubt is None else (*mapped.warnings, doubt)
  return dataclasses.replace(mapped, model=model, strategy=words, shutter=found, warnings=warnings)


def _describe(
  result: Mapped,
  total: int,
  known: KnownPoses | None,
  images_folder: Path,
  turned: frozenset[str],
  steps: Steps,
) -> Localisation:
  """Moves the model into the unit frame (in place) and gathers the figures."""
  steps.end()
  model = result.model
  seen = any(point.track.length() for point in model.points3D.values())
  if seen and (known is None or not known.is_metric):  # else points came with errors and colours
    model.update_point_3d_errors()
    model.extract_colors_for_all_images(str(images_folder))
  images = mapping.registered(model)
  poses = upright_poses(poses_of(images), np.array([i.name in turned for i in images], bool))
  solid = [p.xyz for p in model.points3D.values() if p.track.length() >= 3]
  if not solid:
    solid = [p.xyz for p in model.points3D.values()]
  unit = choose_unit_frame(poses, np.array(solid).reshape(-1, 3))
  model.transform(pycolmap.Sim3d(unit.matrix))
  values = {
    "registered_fraction": model.num_reg_images() / total,
    "reprojection_error_px": reprojection_error(model),
    "strategy": result.strategy,
    "unit_from_source": unit,
    "shutter": None if result.shutter is None else result.shutter.scaled(unit.scale),
    "warnings": result.warnings,
    "left_out": result.left_out,
    "seconds": dict(steps.seconds),
  }
  return from_model(model, values)
