"""Maps verified matches: attempts by the mappers, of which the best is checked and kept.

Of attempts at photographs that one is best whose pictures see most of what they ought to of each
other, of attempts at a film the one whose camera leaps least. Of two mappers' models, checked, it
is always the former.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from nerf2real.core.progress import part
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.checks import agreement
from nerf2real.scenes.poses.checks.attempts import best_of
from nerf2real.scenes.poses.checks.overlap import CLEAR, overlap
from nerf2real.scenes.poses.film import continuity, motion_prior, readout
from nerf2real.scenes.poses.matching.features import quiet
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.work import Steps

_CHECKS = 3  # at most: what is out of line once more agrees with yet another wrong place


class Best(NamedTuple):
  """What the mappers found."""

  model: pycolmap.Reconstruction | None
  how: str
  apart: float  # how far attempts are apart, see `attempts`
  out: frozenset[str]  # pictures that were out of a film's line


def best_model(
  database: Path,
  images_folder: Path,
  count: int,
  settings: LocaliseSettings,
  steps: Steps,
  times: Mapping[str, float] | None,
) -> Best:
  """Runs the mapper of the settings, and the other one if that leaves too many keyframes out.

  Args:
    database: Features and verified matches.
    images_folder: The keyframes.
    count: How many there are.
    settings: Which mapper, how many attempts.
    steps: Told of the progress.
    times: When each picture of a film was taken [s]; None for photographs.

  Raises:
    ValueError: If the settings name no mapper.
  """
  mappers = {"incremental": mapping.map_incrementally, "global": mapping.map_globally}
  if settings.mapper not in ("auto", *mappers):
    raise ValueError(f"mapper is {settings.mapper!r}, expected 'auto', 'global' or 'incremental'.")
  order = list(mappers) if settings.mapper == "auto" else [settings.mapper]
  best = Best(None, f"{order[0]} mapper", 0.0, frozenset())
  attempts = settings.attempts if count <= settings.attempted else 1

  timed = times if times is not None and readout.frame_period(times) is not None else None

  def worth(model: pycolmap.Reconstruction) -> float:
    if timed is None:
      return overlap(model).balance
    return -motion_prior.roughness(*motion_prior.path(model, timed))[1]

  for name in order:

    def attempt(number: int, name: str = name) -> pycolmap.Reconstruction | None:
      seed, ends = settings.seed + number, (number / attempts, (number + 1) / attempts)
      report = part(steps.report, *ends)
      models = mappers[name](database, images_folder, seed=seed, report=report)
      if not models:
        return None
      with quiet():
        pycolmap.ObservationManager(models[0]).filter_all_points3D(
          mapping.MAX_ERROR, mapping.MIN_ANGLE
        )
      mapping.drop_weak_images(models[0])
      return models[0]

    found, unsure = best_of(
      attempt,
      worth,
      attempts=attempts,
      same=settings.max_apart,
      clear=CLEAR if timed is None else math.inf,  # that it leaps less makes a film no surer
    )
    if found is not None:
      model, what, out = _checked(found, database, images_folder, settings, steps, times)
      if sees_more(model, best.model):
        best = Best(model, f"{name} mapper{what}", unsure, out)
    if best.model is not None and best.model.num_reg_images() >= settings.repair_below * count:
      break
  return best


def sees_more(model: pycolmap.Reconstruction | None, other: pycolmap.Reconstruction | None) -> bool:
  """Whether a model's pictures see more of what they ought to, see `overlap`; None is the least."""
  if model is None or other is None:
    return model is not None
  return overlap(model).balance > overlap(other).balance


def _checked(
  model: pycolmap.Reconstruction,
  database: Path,
  images_folder: Path,
  settings: LocaliseSettings,
  steps: Steps,
  times: Mapping[str, float] | None,
) -> tuple[pycolmap.Reconstruction, str, frozenset[str]]:
  """Returns a model without the wrong places that its matches show, what was done, in words, and
  which pictures were out of a film's line.

  Pictures keep their places where those that are found anew see less of what they ought to. What is
  out of a film's line is placed once more, by others than those that agreed with the lost place.
  """
  placed, out, misled = 0, frozenset[str](), frozenset[tuple[int, int]]()
  for _ in range(_CHECKS):
    again, moved = agreement.place_again(
      model, database, images_folder, seed=settings.seed, misled=misled, report=steps.report
    )
    if moved and overlap(again).balance >= overlap(model).balance:
      model, placed = again, placed + moved
    if times is None:
      break
    lost = continuity.drop_out_of_line(model, database, times)
    out, misled = out | lost.names, misled | lost.misled
    if not lost.names:
      break
  out -= {image.name for image in mapping.registered(model)}
  words = f", {placed} pictures placed by what the others see" if placed else ""
  return model, words + (f", {len(out)} left out of the film's line" if out else ""), out
