"""Judges whether enough keyframes have a place, and says what to film where they have not."""

import math

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.localisation import LocalisationError
from nerf2real.scenes.poses.settings import LocaliseSettings

_BETWEEN = (
  "take pictures from places in between, a step apart, so that each shows two thirds of what the "
  "one before shows, with textured things in view"
)


def needed(count: int, settings: LocaliseSettings) -> int:
  """How many of `count` keyframes must have a place."""
  few = min(settings.min_registered, math.ceil(settings.few_fraction * count))
  return max(math.ceil(settings.min_fraction * count), few)


def check_registered(
  model: pycolmap.Reconstruction | None,
  names: list[str],
  settings: LocaliseSettings,
  share: float | None,
  *,
  film: bool,
) -> None:
  """Raises LocalisationError if too few keyframes have a place."""
  number = 0 if model is None else model.num_reg_images()
  least = needed(len(names), settings)
  if number >= least:
    return
  if share is None:
    why = "hardly any two pictures show the same textured surface (blur, plain walls, fast turns)"
    advice = (
      "film slower, with more light, and keep textured things in view while turning"
      if film
      else _BETWEEN
    )
  elif share < settings.min_parallax:
    why = "the camera hardly moved sideways, so depth cannot be seen"
    advice = "walk through the room instead of turning on the spot"
  else:
    why = "they fall into groups that share too little (blur, plain walls, gaps)"
    advice = (
      "film slower and in one go, or take more pictures from places in between, and come back to "
      "what was seen before"
      if film
      else _BETWEEN
    )
  error = LocalisationError(
    f"{number} of {len(names)} keyframes were localised, expected at least {least}: probably "
    f"{why}; {advice}."
  )
  placed = set() if model is None else {image.name for image in mapping.registered(model)}
  error.missing = frozenset(names) - placed
  raise error
