"""Judges contact geometry of a real room by sight lines of held-out pictures to localised points.

Where a picture shows a point, the line between is free: a part across it is wrong. Where there is a
point, there is matter: a point far from every part and from the floor is missed. No truth is
needed, so every capture has the figure; what the judge itself gets wrong is measured on the
built-in room, where its points can be held against the truth. Points that judge are localised to
half the tolerance: their deviation follows from their reprojection error and from where they were
seen from. The held-out pictures trained nothing, but the points may have guided training through
other pictures that see them, too.
Shapes: S sight lines, N pictures, P points.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy import spatial

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.geometry import collision, convex
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.quality.collision_error import sample_parts

TOLERANCE = 0.05  # m that matter may be away, as the other figures of contact geometry count
FIT = 0.1  # m that 95 % may be wrong by in geometry to train in: a robot's foot is 0.12 m long
_LEAST_ERROR = 0.5  # reprojection error that a deviation is reckoned with at least [pixel]
_FEWEST_VIEWS = 4  # pictures that see a point that judges
_STEPS = 200  # of a march along a sight line; the closest of lines graze surfaces at centimetres
_CONTACT = 0.005  # m from a true surface at which a march ends


class SightLines(NamedTuple):
  """Lines from cameras to the points that they see, world frame."""

  eyes: np.ndarray  # [S, 3] m
  points: np.ndarray  # [S, 3] m

  @property
  def lengths(self) -> np.ndarray:
    """Lengths [S] [m]."""
    length: np.ndarray = np.linalg.norm(self.points - self.eyes, axis=-1)
    return length


class Judgement(NamedTuple):
  """What sight lines say of a geometry."""

  lines: int  # that judged
  blocked: float  # share that matter crosses more than the tolerance before the point
  blocked_p95: float  # 95th percentile of where matter begins before the point [m]
  missed: float  # share of points with no matter within the tolerance
  distance_median: float  # of points from matter [m]
  distance_p95: float  # its 95th percentile [m]

  @property
  def unfit(self) -> str | None:
    """What makes the geometry unfit to train in and what to do; None where it is fit."""
    found = []
    if self.blocked_p95 > FIT:
      found.append(
        f"5 % of the sight lines to localised points meet matter {self.blocked_p95:.2f} m or more "
        "before their point"
      )
    if self.distance_p95 > FIT:
      found.append(f"5 % of the points lie {self.distance_p95:.2f} m or more from all matter")
    if not found:
      return None
    return (
      f"The contact geometry is unfit to train in: {' and '.join(found)}, expected at most "
      f"{FIT:g} m. Film slower, or photograph from more places, with more light, moving sideways "
      "along plain walls and black or shiny things."
    )


def deviations(found: Localisation) -> np.ndarray:
  """Standard deviation [P] [unit] of each point along its least certain direction.

  A picture at distance r fixes the two directions across its ray to the reprojection error times
  r over the focal length. Infinite for points that few pictures see.
  """
  count = len(found.points)
  view, point = np.unique(np.stack(found.tracks[:2]), axis=1)  # once a picture
  ways = found.points[point] - found.world_from_camera[view, :3, 3]
  squares = np.square(ways).sum(-1)
  across = np.eye(3) - ways[:, :, None] * ways[:, None] / squares[:, None, None]
  angle = np.maximum(found.point_errors, _LEAST_ERROR) * found.camera.pixel_angle
  certainty = np.zeros((count, 3, 3))
  np.add.at(certainty, point, across / (squares * angle[point] ** 2)[:, None, None])
  deviation = np.full(count, np.inf)
  judging = np.bincount(point, minlength=count) >= _FEWEST_VIEWS
  deviation[judging] = 1 / np.sqrt(np.linalg.eigvalsh(certainty[judging])[:, 0])
  return deviation


def sight_lines(
  found: Localisation,
  held_out: np.ndarray,
  world_from_unit: Similarity,
  *,
  lower: np.ndarray,
  upper: np.ndarray,
) -> SightLines:
  """Lists the sight lines of pictures to well localised points inside a box.

  Args:
    found: The localised pictures and points, unit frame.
    held_out: Which pictures were held out, bool [N].
    world_from_unit: Maps them to the world.
    lower: Lower corner of the contact geometry [3] [m].
    upper: Upper corner [3] [m].
  """
  seen = found.tracks.of_points(deviations(found) * world_from_unit.scale < TOLERANCE / 2)
  judging = held_out[seen.view]
  eyes = world_from_unit.apply(found.world_from_camera[seen.view[judging], :3, 3])
  points = world_from_unit.apply(found.points[seen.point[judging]])
  inside = ((points > lower) & (points < upper)).all(-1)
  return SightLines(eyes[inside], points[inside])


def judge(lines: SightLines, reach: np.ndarray, distance: np.ndarray) -> Judgement:
  """Judges a geometry by its first hit along each line [S] and the points' distance from it [S]."""
  before = np.maximum(lines.lengths - reach, 0.0)
  return Judgement(
    len(reach),
    float((before > TOLERANCE).mean()),
    float(np.percentile(before, 95)),
    float((distance > TOLERANCE).mean()),
    float(np.median(distance)),
    float(np.percentile(distance, 95)),
  )


def judge_parts(lines: SightLines, parts: Sequence[convex.Part]) -> Judgement | None:
  """Judges convex parts and the floor plane at z = 0; None where there is no sight line."""
  if not len(lines.eyes):
    return None
  model = collision.spec(parts).compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  directions = (lines.points - lines.eyes) / lines.lengths[:, None]
  reach, geom = np.empty(len(directions)), np.zeros(1, np.int32)
  for row, (eye, direction) in enumerate(zip(lines.eyes, directions, strict=True)):
    found = mujoco.mj_ray(model, data, eye, direction, None, 1, -1, geom)
    reach[row] = found if geom[0] >= 0 else np.inf
  to_parts = spatial.cKDTree(sample_parts(parts)).query(lines.points)[0]
  return judge(lines, reach, np.minimum(to_parts, np.abs(lines.points[:, 2])))


def judge_truth(
  lines: SightLines, distance_to_surface: Callable[[np.ndarray], np.ndarray]
) -> Judgement:
  """Judges the true surface, whose every fault is the judge's own.

  Args:
    lines: Sight lines in the truth's frame.
    distance_to_surface: Distances [P] of points [P, 3] from the true surface, outside it [m].
  """
  directions = (lines.points - lines.eyes) / lines.lengths[:, None]
  reach = np.zeros(len(directions))
  going = np.arange(len(directions))
  for _ in range(_STEPS):
    near = np.abs(distance_to_surface(lines.eyes[going] + reach[going, None] * directions[going]))
    reach[going] += near
    going = going[(near > _CONTACT) & (reach[going] < lines.lengths[going] + TOLERANCE)]
    if not len(going):
      break
  return judge(lines, reach, np.abs(distance_to_surface(lines.points)))
