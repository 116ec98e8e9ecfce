"""Measures the distance between the convex parts' surface and the scene's surface, both ways.

Only what can be touched counts: the parts' surface is found by MuJoCo's own rays from where cameras
were and from the free space, so the far side of a wall, which nobody sees, is not judged.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy import spatial

from nerf2real.scenes.geometry import collision, convex, triangles

_RAYS = 40_000  # from all eyes together
_SAMPLES_PER_AREA = 5_000  # on the parts [1/m^2]: neighbours 1.4 cm apart
_CROP_EDGE = 0.06  # the parts' upper face, where the crop cut them, is no surface of the scene [m]


class CollisionError(NamedTuple):
  """Distances [m]; p95 is the 95th percentile."""

  parts_to_surface_median: float
  parts_to_surface_p95: float
  surface_to_parts_median: float
  surface_to_parts_p95: float
  parts_within_5cm: float  # share of the touchable collision surface
  surface_within_5cm: float  # share of the scene's surface

  @property
  def p95(self) -> float:
    """The larger of both 95th percentiles: the bundle's collision_error_m."""
    return max(self.parts_to_surface_p95, self.surface_to_parts_p95)


def exposed_points(parts: Sequence[convex.Part], eyes: np.ndarray) -> np.ndarray:
  """Points [P, 3] of the parts' surface that rays from eyes [K, 3] in all directions hit first.

  The floor plane stops rays but its points are left out.
  """
  model = collision.spec(parts).compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  rng = np.random.default_rng(0)
  each = max(1, _RAYS // len(eyes))
  found = []
  for eye in np.asarray(eyes, np.float64):
    direction = rng.standard_normal((each, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    geom, distance = np.empty(each, np.int32), np.empty(each)
    mujoco.mj_multiRay(
      model, data, eye, direction.ravel(), None, True, -1, geom, distance, None, each, 1e3
    )
    hit = geom > 0  # 0 is the floor, -1 nothing
    found.append(eye + distance[hit, None] * direction[hit])
  return np.concatenate(found)


def sample_parts(parts: Sequence[convex.Part]) -> np.ndarray:
  """Points [P, 3] uniform on the surfaces of all parts; always the same."""
  faces = np.concatenate([p.vertices[p.faces] for p in parts])
  count = max(1000, int(triangles.areas(faces).sum() * _SAMPLES_PER_AREA))
  return triangles.draw(np.random.default_rng(0), faces, count)[0]


def collision_error(
  parts: Sequence[convex.Part],
  surface: np.ndarray,
  *,
  eyes: np.ndarray,
  lower: np.ndarray,
  upper: np.ndarray,
  floor_threshold: float = 0.04,
  distance_to_surface: Callable[[np.ndarray], np.ndarray] | None = None,
) -> CollisionError:
  """Measures the convex parts against the scene's surface.

  Args:
    parts: Convex parts, world frame.
    surface: Surface points [P, 3], world frame: lifted depth of the field, or of the truth.
    eyes: Places [K, 3] from which the parts can be touched or seen: cameras and free space.
    lower: Lower corner of the collision crop [3].
    upper: Upper corner of the collision crop [3].
    floor_threshold: Lower points of the surface are floor, which the plane stands for [m].
    distance_to_surface: Exact distances [P] of points [P, 3] from the surface, where a truth is
      known; otherwise the nearest of the surface points is taken.
  """
  keep = ((surface > lower) & (surface < upper)).all(-1) & (surface[:, 2] > floor_threshold)
  if not keep.any():
    raise ValueError("No surface point lies inside the collision crop: check extent and scale.")
  cells = np.floor(surface[keep] / 0.01).astype(np.int64)  # near surfaces fill many pixels
  _, first = np.unique(cells, axis=0, return_index=True)
  thinned = surface[keep][first]
  touched = exposed_points(parts, eyes)
  crop = np.asarray(upper) - [0, 0, _CROP_EDGE]
  touched = touched[((touched > lower) & (touched < crop)).all(-1)]
  touched = touched[touched[:, 2] > floor_threshold]
  if not len(touched):
    raise ValueError("No ray from the eyes meets a convex part inside the collision crop.")
  if distance_to_surface is None:
    everything = np.concatenate([surface[~keep][::4], thinned])
    to_surface = spatial.cKDTree(everything).query(touched, workers=-1)[0]
  else:
    to_surface = np.abs(distance_to_surface(touched))
  to_parts = spatial.cKDTree(sample_parts(parts)).query(thinned, workers=-1)[0]
  to_parts = np.minimum(to_parts, thinned[:, 2])  # the plane
  return CollisionError(
    float(np.median(to_surface)),
    float(np.percentile(to_surface, 95)),
    float(np.median(to_parts)),
    float(np.percentile(to_parts, 95)),
    float((to_surface < 0.05).mean()),
    float((to_parts < 0.05).mean()),
  )
