"""Finds the metric scale: by hand, from a marker or depth sensor, cameras' height, or a guess."""

from typing import NamedTuple

import numpy as np

from nerf2real.scenes.alignment.evidence import Choice, Evidence
from nerf2real.scenes.alignment.floor import Floor
from nerf2real.scenes.alignment.overrides import Overrides

_METRES_ASSUMED = (
  "Metres were assumed for depth and the poses that agree with it, as their file names no unit: "
  "where both are of structure from motion, give --camera-height, or film a marker and give "
  "--marker-side."
)


class Scale(NamedTuple):
  """The metric scale."""

  metres_per_unit: float
  spread: float | None = None  # relative standard deviation, where it is known


def choose_scale(
  evidence: Evidence,
  override: Overrides,
  *,
  floor: Floor,
  camera_height: float | None,
  guessed_camera_height: float,
  max_marker_spread: float,
) -> Choice[Scale]:
  """Finds the metric scale from the override, a marker, a depth sensor, a camera height or a guess.

  Args:
    evidence: Cameras, marker, and the sensor's scale; a camera height comes before it where its
      metres are assumed.
    override: Values given by hand.
    floor: The floor, from which the cameras' median height is counted.
    camera_height: That height where it is known [m].
    guessed_camera_height: That height where nothing is known [m].
    max_marker_spread: A marker whose scale is less certain (relative) is not used.

  Raises:
    ValueError: The floor lies above the cameras.
  """
  height = float(np.median(floor.heights(evidence.positions)))  # units
  if height <= 0:
    raise ValueError(
      f"The floor lies above the cameras, by {-height:.3g} units in the median: correct "
      "floor_points or up in the override file."
    )
  warnings: tuple[str, ...] = ()
  if override.scale is not None:
    return Choice(Scale(override.scale), "manual")
  if override.scale_points is not None and override.scale_distance is not None:
    distance = float(np.linalg.norm(override.scale_points[1] - override.scale_points[0]))
    return Choice(Scale(override.scale_distance / distance), "points")
  if override.camera_height is not None:
    return Choice(Scale(override.camera_height / height), "camera_height")
  marker = evidence.marker
  if marker is not None:
    if marker.spread <= max_marker_spread:
      return Choice(Scale(marker.metres_per_unit, marker.spread), "marker")
    warnings += (
      f"The marker's scale is uncertain by {100 * marker.spread:.1f} %, more than "
      f"{100 * max_marker_spread:g} %: not used. Film it from nearer and more sides.",
    )
  known_height = camera_height is not None
  if evidence.sensor_scale is not None and not (evidence.metres_assumed and known_height):
    if evidence.metres_assumed:
      warnings += (_METRES_ASSUMED,)
    return Choice(Scale(evidence.sensor_scale), "depth_sensor", warnings)
  if camera_height is not None:
    return Choice(Scale(camera_height / height), "camera_height", warnings)
  warnings += (
    f"SCALE UNKNOWN: guessed from a camera height of {guessed_camera_height:g} m and easily wrong "
    "by 20 %. Film a marker of known size, or give scale_points with scale_distance, camera_height "
    "or scale in the override file.",
  )
  return Choice(Scale(guessed_camera_height / height), "unknown", warnings)
