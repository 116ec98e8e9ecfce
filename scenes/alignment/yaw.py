"""Finds the walls' direction and puts the longer side of the room along x. Shapes: P points."""

import numpy as np

from nerf2real.core.geometry.rotations import yaw_matrix
from nerf2real.scenes.alignment.evidence import Choice, Evidence
from nerf2real.scenes.alignment.marker_place import MarkerPlace, upper_edge
from nerf2real.scenes.alignment.overrides import Overrides

# Of the unit frame's angles about z, the one that the world's x axis is nearest to. Walls lie along
# the unit frame's axes or at 45 degrees to them: neither has two quarter turns equally near.
_REFERENCE = np.pi / 8
_LONGER = 1.05  # times the other side; nearly square rooms have no longer side


def wall_yaw(normals: np.ndarray) -> float | None:
  """Direction of the walls from normals [P, 3], z up: an angle in [0, pi/2), or None.

  The mode of the angles modulo a quarter turn, refined by their circular mean near it.
  """
  level = np.hypot(normals[:, 0], normals[:, 1])
  upright = (level > 0.95) & (np.abs(normals[:, 2]) < 0.3)
  if upright.sum() < 100:
    return None
  angle = np.mod(np.arctan2(normals[upright, 1], normals[upright, 0]), np.pi / 2)
  bins = 90
  counts, _ = np.histogram(angle, bins, (0, np.pi / 2))
  smooth = sum((np.roll(counts, shift) for shift in range(-3, 4)), np.zeros(bins))
  mode = (np.argmax(smooth) + 0.5) * np.pi / 2 / bins
  if smooth.max() < 1.5 * 7 / bins * counts.sum():  # no direction stands out
    return None
  width = np.radians(8)
  for _ in range(5):
    offset = np.mod(angle - mode + np.pi / 4, np.pi / 2) - np.pi / 4
    kernel = np.exp(-0.5 * (offset / (width / 2)) ** 2)
    mode += float((kernel * offset).sum() / kernel.sum())
    width = max(width * 0.7, np.radians(3))
  return float(np.mod(mode, np.pi / 2))


def point_yaw(points: np.ndarray) -> float:
  """Direction of the walls from points [P, 3] with z up: the least entropy of both projections."""
  flat = points[:, :2] - np.median(points[:, :2], axis=0)
  flat = flat[np.linalg.norm(flat, axis=-1) < np.percentile(np.linalg.norm(flat, axis=-1), 98)]
  span = np.abs(flat).max()

  def entropy(angle: float) -> float:
    turned = flat @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    total = 0.0
    for axis in range(2):
      counts, _ = np.histogram(turned[:, axis], 200, (-1.5 * span, 1.5 * span))
      share = counts[counts > 0] / len(flat)
      total -= (share * np.log(share)).sum()
    return total

  coarse = np.radians(np.arange(0, 90, 1.0))
  best = coarse[np.argmin([entropy(a) for a in coarse])]
  fine = best + np.radians(np.arange(-1, 1.01, 0.1))
  return float(np.mod(fine[np.argmin([entropy(a) for a in fine])], np.pi / 2))


def choose_yaw(
  evidence: Evidence,
  override: Overrides,
  *,
  upright: np.ndarray,
  in_room: np.ndarray,
  marker_at: MarkerPlace | None = None,
) -> Choice[np.ndarray]:
  """Finds the rotation [3, 3] from the unit frame to the world's axes.

  Args:
    evidence: The points; dense ones have normals.
    override: Values given by hand.
    upright: Rotation [3, 3] that turns the floor's normal to z.
    in_room: Which of the densest points stand on the floor, bool [P].
    marker_at: Where the marker is to be in the world; None: along the walls.
  """
  if override.yaw_deg is not None:
    return Choice(yaw_matrix(-np.radians(override.yaw_deg)) @ upright, "manual")
  if marker_at is not None and evidence.marker is not None:
    turn = np.radians(marker_at.heading_deg) - upper_edge(evidence.marker, upright)
    return Choice(yaw_matrix(turn) @ upright, "marker")
  yaw, source = None, "walls"
  if evidence.surface_normals is not None:
    yaw = wall_yaw(evidence.surface_normals[in_room] @ upright.T)
  points = evidence.densest
  if yaw is None:
    chosen = points[in_room] if in_room.sum() > 100 else points
    yaw, source = point_yaw(chosen @ upright.T), "points"
  along_walls = yaw_matrix(-yaw) @ upright
  return Choice(
    longer_side_along_x(along_walls, points[in_room] if in_room.any() else points), source
  )


def longer_side_along_x(rotation: np.ndarray, points: np.ndarray) -> np.ndarray:
  """Adds the quarter turn that puts the longer side of points [P, 3] along x.

  Of the two such turns, or of all four where the sides are nearly equal, the one is taken whose x
  axis is nearest to `_REFERENCE` in the unit frame.
  """
  spans = [np.ptp(np.quantile(points @ rotation[axis], [0.02, 0.98])) for axis in range(2)]
  quarters = [0, 1, 2, 3]
  if max(spans) > _LONGER * min(spans):
    quarters = [0, 2] if spans[0] > spans[1] else [1, 3]
  turned = [yaw_matrix(quarter * np.pi / 2) @ rotation for quarter in quarters]
  reference = np.array([np.cos(_REFERENCE), np.sin(_REFERENCE), 0.0])
  return max(turned, key=lambda candidate: float(candidate[0] @ reference))
