"""Merges neighbouring convex parts to fewer. Shape: N parts."""

import heapq

import numpy as np

from nerf2real.scenes.geometry.convex import Part, Space, hull, intrusion_of


class _Boxes:
  """Bounding boxes of parts that come and go."""

  def __init__(self, parts: list[Part]):
    count = 2 * len(parts) + 1  # two parts become one: fewer than twice as many ever are
    self._lower, self._upper = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for index, part in enumerate(parts):
      self.put(index, part)

  def put(self, index: int, part: Part) -> None:
    self._lower[index], self._upper[index] = part.vertices.min(0), part.vertices.max(0)

  def remove(self, index: int) -> None:
    self._lower[index] = np.inf

  def touching(self, index: int, gap: float) -> list[int]:
    """Indices of the other boxes within a gap."""
    near = (self._lower <= self._upper[index] + gap).all(1)
    near &= (self._upper >= self._lower[index] - gap).all(1)
    near[index] = False
    return np.flatnonzero(near).tolist()


def merge(
  parts: list[Part], space: Space, *, tolerance: float, max_parts: int, max_vertices: int
) -> list[Part]:
  """Merges neighbours whose hull keeps out of free space, those that add least volume first.

  Where too many parts are left, those are merged whose hull reaches into free space least.

  Args:
    parts: Convex parts.
    space: Free space.
    tolerance: A hull may reach this far into it [m].
    max_parts: Parts are merged until they are this few, whatever their hulls take.
    max_vertices: Of a part.
  """
  alive: dict[int, Part] = dict(enumerate(parts))
  boxes = _Boxes(parts)
  fresh = len(parts)
  # How deep a hull reaches, what it adds, which two, the hull, and whether its depth is known yet.
  heap: list[tuple[float, float, int, int, Part, bool]] = []

  def offer(i: int, others: list[int]) -> None:
    for j in others:
      points = np.concatenate([alive[i].vertices, alive[j].vertices])
      joined = hull(points, max_vertices=max_vertices)
      if joined is not None:
        added = joined.volume - alive[i].volume - alive[j].volume
        heapq.heappush(heap, (0.0, added, j, i, joined, False))

  for i in alive:
    offer(i, [j for j in boxes.touching(i, 1.5 * space.voxel) if j < i])
  while heap:
    deep, added, i, j, joined, known = heapq.heappop(heap)
    if i not in alive or j not in alive:
      continue
    if not known:  # most pairs lose one of the two before it is their turn
      found = intrusion_of(joined, space, tolerance)
      if not found.allowed:
        heapq.heappush(heap, (found.deep, added, i, j, joined, True))
        continue
    if deep > 0 and len(alive) <= max_parts:
      break
    for index in (i, j):
      del alive[index]
      boxes.remove(index)
    alive[fresh] = joined
    boxes.put(fresh, joined)
    offer(fresh, boxes.touching(fresh, 1.5 * space.voxel))
    fresh += 1
  return list(alive.values())
