"""Convex solids that the built-in room is made of, each with an exact distance and a mesh.

One list of solids is at once the room's picture, its contact geometry and its truth.
Shapes: P points, V vertices, F faces. Metres.
"""

import dataclasses
from collections.abc import Iterable

import numpy as np

_BISECTIONS = 40  # halvings of the bracket of the ellipsoid's nearest point: below 1e-9 m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solid:
  """A placed solid and the look of its surface."""

  name: str
  """Unique."""
  kind: str
  """"box" (half sizes), "cone" (bottom radius, top radius, half height) or "ellipsoid"."""
  size: tuple[float, float, float]
  """See kind [m]."""
  position: np.ndarray
  """Of the centre in the world [3]."""
  rotation: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
  """World from solid."""
  rounding: float = 0.0
  """Radius of a box's edges; the half sizes include it [m]."""
  material: str
  """Name of the texture."""
  tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
  """Multiplies the texture."""
  tiles: float | None = 1.0
  """Textures per metre; None: one texture fits the local +z face."""
  window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
  """U, v from, to, when it fits."""
  offset: tuple[float, float] = (0.0, 0.0)
  """Shift of the texture."""

  def to_local(self, points: np.ndarray) -> np.ndarray:
    """Maps world points [P, 3] into the solid's frame."""
    return (points - self.position) @ self.rotation

  @property
  def bounding_radius(self) -> float:
    """Radius about the centre of a sphere that holds the solid [m]."""
    a, b, c = self.size
    return float(np.hypot(max(a, b), c) if self.kind == "cone" else np.linalg.norm([a, b, c]))

  def signed_distance(self, points: np.ndarray) -> np.ndarray:
    """Returns the distance from world points [P, 3] to the surface [P]; negative inside."""
    local = self.to_local(np.asarray(points, np.float64))
    if self.kind == "box":
      return _box_distance(local, np.asarray(self.size) - self.rounding) - self.rounding
    if self.kind == "cone":
      return _cone_distance(local, *self.size)
    return _ellipsoid_distance(local, np.asarray(self.size))


def _box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
  q = np.abs(points) - half
  return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def _cone_distance(points: np.ndarray, bottom: float, top: float, half: float) -> np.ndarray:
  """Signed distance to a capped cone along z, by the nearest of its three profile segments."""
  q = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], -1)
  cap_radius = np.where(q[:, 1] < 0, bottom, top)
  to_cap = np.stack([q[:, 0] - np.minimum(q[:, 0], cap_radius), np.abs(q[:, 1]) - half], -1)
  start, edge = np.array([top, half]), np.array([bottom - top, -2 * half])
  t = np.clip((q - start) @ edge / (edge @ edge), 0, 1)
  to_side = q - start - t[:, None] * edge
  inside = (to_side[:, 0] < 0) & (to_cap[:, 1] < 0)
  square = np.minimum((to_cap**2).sum(-1), (to_side**2).sum(-1))
  return np.where(inside, -1.0, 1.0) * np.sqrt(square)


def _ellipsoid_distance(points: np.ndarray, radii: np.ndarray) -> np.ndarray:
  """Signed distance to an ellipsoid.

  Bisects g(t) = sum_i (r_i y_i / (t + r_i^2))^2 - 1 on its decreasing branch. Source: Eberly 2013,
  Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid.
  """
  y = np.maximum(np.abs(points), 1e-9)
  smallest = radii.min()
  low = -(smallest**2) + smallest * y[:, int(radii.argmin())]
  high = -(smallest**2) + np.linalg.norm(radii * y, axis=-1)
  for _ in range(_BISECTIONS):
    middle = 0.5 * (low + high)
    g = ((radii * y / (middle[:, None] + radii**2)) ** 2).sum(-1) - 1
    low, high = np.where(g > 0, middle, low), np.where(g > 0, high, middle)
  nearest = radii**2 * y / (0.5 * (low + high)[:, None] + radii**2)
  distance = np.linalg.norm(y - nearest, axis=-1)
  return np.where(((points / radii) ** 2).sum(-1) < 1, -distance, distance)


def distance(solids: Iterable[Solid], points: np.ndarray, *, limit: float = np.inf) -> np.ndarray:
  """Returns the signed distance from points [P, 3] to the union of solids [P] [m].

  Outside it is exact. Inside it is the depth in the solid that holds the point the deepest, which
  for overlapping solids is a bound on the depth. Distances over the limit are not looked for: the
  limit is returned.
  """
  points = np.asarray(points, np.float64).reshape(-1, 3)
  best = np.full(len(points), limit)
  near_first = sorted(solids, key=lambda solid: -solid.bounding_radius)
  low, high = points.min(0, initial=np.inf), points.max(0, initial=-np.inf)
  for solid in near_first:
    outside = np.maximum(np.maximum(low - solid.position, solid.position - high), 0)
    if np.linalg.norm(outside) - solid.bounding_radius >= limit:
      continue  # none of the points is near enough
    reach = np.linalg.norm(points - solid.position, axis=-1) - solid.bounding_radius
    todo = reach < best
    if todo.any():
      best[todo] = np.minimum(best[todo], solid.signed_distance(points[todo]))
  return best


@dataclasses.dataclass(frozen=True)
class Mesh:
  """A triangle mesh in the solid's frame, with one normal and texture coordinate a vertex."""

  vertices: np.ndarray
  """[V, 3]."""
  normals: np.ndarray
  """[V, 3]."""
  texcoords: np.ndarray
  """[V, 2]."""
  faces: np.ndarray
  """[F, 3], counter-clockwise from outside."""


def tessellate(solid: Solid) -> Mesh:
  """Returns the solid's surface as triangles, with texture coordinates."""
  if solid.kind == "box":
    return _box_mesh(solid)
  return _cone_mesh(solid) if solid.kind == "cone" else _ellipsoid_mesh(solid)


def _grid_faces(rows: int, columns: int) -> np.ndarray:
  """Two triangles a cell of a grid of rows x columns vertices, [F, 3]."""
  corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
  a, b, c, d = corner, corner + 1, corner + columns + 1, corner + columns
  return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def _box_mesh(solid: Solid) -> Mesh:
  half = np.asarray(solid.size)
  steps = np.array([-1.0, 1.0])
  core = half - solid.rounding
  parts = []
  for axis in range(3):
    for sign in (-1.0, 1.0):
      u_axis, v_axis = (axis + 1) % 3, (axis + 2) % 3
      if sign < 0:
        u_axis, v_axis = v_axis, u_axis
      us = vs = steps
      if solid.rounding:
        arc = solid.rounding * np.tan(np.linspace(0, np.pi / 4, 5))
        us = np.concatenate([-(core[u_axis] + arc[::-1]), core[u_axis] + arc]) / half[u_axis]
        vs = np.concatenate([-(core[v_axis] + arc[::-1]), core[v_axis] + arc]) / half[v_axis]
      v, u = np.meshgrid(vs, us, indexing="ij")
      points = np.empty((u.size, 3))
      points[:, axis] = sign
      points[:, u_axis], points[:, v_axis] = u.ravel(), v.ravel()
      points *= half
      normals = np.zeros_like(points)
      normals[:, axis] = sign
      if solid.rounding:
        inner = np.clip(points, -core, core)
        normals = points - inner
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        points = inner + solid.rounding * normals
      parts.append((points, normals, _box_texcoords(solid, points, axis, sign), (len(vs), len(us))))
  offsets = np.cumsum([0] + [len(p[0]) for p in parts[:-1]])
  return Mesh(
    np.concatenate([p[0] for p in parts]),
    np.concatenate([p[1] for p in parts]),
    np.concatenate([p[2] for p in parts]),
    np.concatenate([_grid_faces(*p[3]) + o for p, o in zip(parts, offsets, strict=True)]),
  )


def _box_texcoords(solid: Solid, points: np.ndarray, axis: int, sign: float) -> np.ndarray:
  """Texture coordinates [V, 2]; u runs along the longer side of a face unless the texture fits."""
  if solid.tiles is None:
    u0, v0, u1, v1 = solid.window
    if axis == 2 and sign > 0:
      t = 0.5 + 0.5 * points[:, :2] / np.asarray(solid.size)[:2]
      return np.stack([u0 + t[:, 0] * (u1 - u0), v1 + t[:, 1] * (v0 - v1)], -1)
    edge = np.array([u0 + 0.02 * (u1 - u0), v0 + 0.02 * (v1 - v0)])
    return np.tile(edge, (len(points), 1))
  others = sorted({0, 1, 2} - {axis}, key=lambda k: -solid.size[k])
  shift = np.asarray(solid.offset) + 0.37 * axis + 0.19 * sign
  return points[:, others] * solid.tiles + shift


def _cone_mesh(solid: Solid) -> Mesh:
  bottom, top, half = solid.size
  angle = np.linspace(0, 2 * np.pi, 33)
  ring = np.stack([np.cos(angle), np.sin(angle)], -1)
  slope = np.array([2 * half, bottom - top]) / np.hypot(2 * half, bottom - top)
  normal = np.column_stack([ring * slope[0], np.full(33, slope[1])])
  levels = []
  for z, radius in ((-half, bottom), (half, top)):
    levels.append(np.column_stack([ring * radius, np.full(33, z)]))
  tiles = solid.tiles or 1.0
  perimeter = np.pi * (bottom + top) * tiles
  u = np.linspace(0, max(round(perimeter), 1) if perimeter > 0.5 else perimeter, 33)
  vertices, normals = [*levels], [normal, normal]
  texcoords = [np.stack([u, np.full(33, z * tiles)], -1) + solid.offset for z in (half, -half)]
  faces = [_grid_faces(2, 33)]
  for level, sign in ((0, -1.0), (1, 1.0)):
    start = sum(len(part) for part in vertices)
    cap = np.vstack([levels[level], [[0, 0, sign * half]]])
    vertices.append(cap)
    normals.append(np.tile([0, 0, sign], (34, 1)))
    texcoords.append(cap[:, :2] * tiles + solid.offset)
    k = np.arange(32)
    fan = np.stack([np.full(32, 33), k, k + 1] if sign > 0 else [np.full(32, 33), k + 1, k], -1)
    faces.append(fan + start)
  return Mesh(*(np.concatenate(part) for part in (vertices, normals, texcoords, faces)))


def _ellipsoid_mesh(solid: Solid) -> Mesh:
  radii = np.asarray(solid.size)
  polar, azimuth = np.meshgrid(
    np.linspace(1e-3, np.pi - 1e-3, 13), np.linspace(0, 2 * np.pi, 21), indexing="ij"
  )
  unit = np.stack(
    [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1
  ).reshape(-1, 3)
  vertices = unit * radii
  normals = unit / radii
  normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
  if solid.tiles is None:
    texcoords = 0.5 + 0.5 * unit[:, :2]
  else:
    texcoords = vertices[:, :2] * solid.tiles + solid.offset
  return Mesh(vertices, normals, texcoords, _grid_faces(13, 21)[:, ::-1])
