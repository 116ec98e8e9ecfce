"""What a room's report says first: its pictures, its contact geometry, its floor, its size."""

from collections.abc import Mapping
from typing import Any

from nerf2real.core.pages.blocks import Answer, Answers
from nerf2real.core.pages.page import Section
from nerf2real.scenes.quality.sight_lines import FIT

_SCALES = {
  "marker": "From a marker of known size",
  "points": "From a distance that was given",
  "manual": "From a scale that was given",
  "depth_sensor": "From a depth sensor",
  "camera_height": "From the camera's height that was given",
  "unknown": "A guess",
}
"""Where a scale comes from, by the name in scene.json."""


def section(figures: Mapping[str, Any]) -> Section:
  """Returns the first section of a room's report.

  Args:
    figures: Those of scene.json, by name; what is missing or None was not measured.
  """
  known = {name: value for name, value in figures.items() if value is not None}
  answers = [_pictures(known), _geometry(known), _floor(known), _size(known)]
  return Section("In short", "", [Answers([answer for answer in answers if answer is not None])])


def _pictures(figures: Mapping[str, Any]) -> Answer | None:
  if "held_out_psnr_db" not in figures:
    return None
  words = [f"PSNR, the mean of {figures['held_out_views']:.0f} pictures that training never saw; "]
  words[0] += "higher is better. They are shown below, the worst first."
  if "held_out_psnr_30x40_db" in figures:
    words.append(f"At the robot's 30x40 pixels: {figures['held_out_psnr_30x40_db']:.1f} dB.")
  return Answer("How true are the pictures?", f"{figures['held_out_psnr_db']:.1f} dB", words)


def _misses(figures: Mapping[str, Any]) -> tuple[float, float] | None:
  """By what the geometry misses sight lines and points [m]; None where that was not judged."""
  names = ("sight_lines_blocked_p95_m", "points_to_parts_p95_m")
  if not all(name in figures for name in names):
    return None
  return figures[names[0]], figures[names[1]]


def _cm(metres: float) -> str:
  """Centimetres to two digits, and whole ones from ten on."""
  return f"{100 * metres:.0f}" if metres >= 0.1 else f"{100 * metres:.2g}"


def _geometry(figures: Mapping[str, Any]) -> Answer:
  question = "Is the contact geometry fit to train in?"
  misses = _misses(figures)
  if misses is None:
    return Answer(question, "Not judged: too few points were seen well enough", tone="warn")
  blocked, missed = misses
  fit = max(misses) <= FIT
  words = [
    f"Of the lines of sight to localised points 5 % meet matter {_cm(blocked)} cm or more"
    f" before their point, of the points 5 % lie {_cm(missed)} cm or more from all matter;"
    f" at most {100 * FIT:.0f} cm is asked of both."
  ]
  return Answer(question, "Yes" if fit else "No", words, "good" if fit else "warn")


def _floor(figures: Mapping[str, Any]) -> Answer | None:
  if "free_area_m2" not in figures:
    return None
  area, apart = figures["free_area_m2"], figures.get("free_area_apart_m2", 0.0)
  words = []
  if round(apart, 1) > 0:
    lacks = figures.get("passage_lacks_m")
    narrow = "" if lacks is None else f"; the widest way there lacks {100 * lacks:.0f} cm"
    words.append(f"{apart:.1f} m² more are behind passages that are too narrow for it{narrow}.")
  answer = f"{area:.1f} m² of floor in one piece" if area > 0 else "Nowhere"
  misses = _misses(figures)
  doubtful = misses is not None and max(misses) > FIT
  if area > 0 and doubtful:
    words.append("Not to be trusted: it is what contact geometry leaves free that is not fit.")
  tone = "" if area > 0 and not doubtful else "warn"
  return Answer("Where can the robot walk?", answer, words, tone)


def _size(figures: Mapping[str, Any]) -> Answer | None:
  source = figures.get("scale_source")
  if source is None:
    return None
  words = []
  if "scale_spread" in figures:
    words.append(f"Its sightings differ by {100 * figures['scale_spread']:.1f} % (deviation).")
  if "marker_place" in figures:
    words.append(figures["marker_place"])
  guessed = source == "unknown"
  if guessed:
    words.append(
      "Lay a marker on the floor and film again, or give a distance or the camera's height."
    )
  question = "Where does the metric scale come from?"
  return Answer(question, _SCALES.get(source, source), words, "warn" if guessed else "")
