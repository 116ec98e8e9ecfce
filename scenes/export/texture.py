"""Bakes a texture for a triangle mesh from posed pictures, or from its vertices' colours.

Two triangles share a square cell of the atlas; cells follow a Morton curve through the room, so
that the averages that a renderer's mipmaps take over neighbouring cells are of neighbouring places.
Shapes: V vertices, F faces, K texels along a cell's edge.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nerf2real.scenes.geometry import fusion, triangles
from nerf2real.scenes.geometry.mesh import Mesh, point_colors

_BORDER = 1.0  # texels between a triangle and its cell's edge: bilinear reads stay inside the cell
_MORTON_BITS = 10  # an axis of the room is cut into 2^10 steps
_MAX_SIZE = 8192  # texels along the atlas; older GPUs take no more
_MIN_CELL = 6  # texels along a cell: two triangles with their borders


@dataclasses.dataclass(frozen=True)
class TexturedMesh:
  """A mesh whose every face has texture coordinates of its own."""

  vertices: np.ndarray  # float64 [V, 3]
  faces: np.ndarray  # int [F, 3]
  uv: np.ndarray  # float64 [F, 3, 2]; (0, 0) is the picture's lower left corner
  texture: np.ndarray  # uint8 [S, S, 3], row 0 on top


def _morton_order(points: np.ndarray) -> np.ndarray:
  """Indices that sort points [P, 3] along a Morton (Z-order) curve."""
  low, span = points.min(0), np.ptp(points, axis=0).max() + 1e-9
  steps = ((points - low) / span * (2**_MORTON_BITS - 1)).astype(np.int64)
  code = np.zeros(len(points), np.int64)
  for bit in range(_MORTON_BITS):
    for axis in range(3):
      code |= ((steps[:, axis] >> bit) & 1) << (3 * bit + axis)
  return np.argsort(code, kind="stable")


def _cell_corners(size: int) -> np.ndarray:
  """Corners [2, 3, 2] (column, row) [texel] of both triangles in a cell of `size` texels."""
  near, far = _BORDER, size - _BORDER
  gap = 2 * _BORDER  # between the two hypotenuses
  return np.array(
    [
      [[near, near], [far - gap, near], [near, far - gap]],
      [[far, far], [near + gap, far], [far, near + gap]],
    ]
  )


def _cell_texels(size: int) -> tuple[np.ndarray, np.ndarray]:
  """Which triangle [K, K] each texel of a cell takes, and its barycentric weights [K, K, 3].

  Texels outside both triangles take the nearest point of the nearer one.
  """
  row, column = np.mgrid[:size, :size] + 0.5
  second = row + column > size
  corners = _cell_corners(size)[second.astype(int)]  # [K, K, 3, 2]
  a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
  offset = np.stack([column, row], -1) - a
  beta = offset[..., 0] / (b - a)[..., 0]  # the legs lie along the axes
  gamma = offset[..., 1] / (c - a)[..., 1]
  weights = np.clip(np.stack([1 - beta - gamma, beta, gamma], -1), 0, None)
  return second.astype(int), weights / weights.sum(-1, keepdims=True)


class _Atlas(NamedTuple):
  """Where the faces of a mesh lie in a texture."""

  size: int  # texels along a cell's edge
  cells: int  # cells along the texture's edge
  place: np.ndarray  # [F] half a cell of every face, along the Morton curve
  cell: np.ndarray  # [F, 2] column and row of its cell

  @property
  def uv(self) -> np.ndarray:
    """Texture coordinates of the faces' corners [F, 3, 2]."""
    corners = self.cell[:, None] * self.size + _cell_corners(self.size)[self.place % 2]
    uv = corners / (self.cells * self.size)
    uv[..., 1] = 1 - uv[..., 1]
    return uv

  def fill(self, color: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Returns the texture, uint8 [S, S, 3].

    Args:
      color: Returns colours [T P, 3] of T points on each of P faces, given the points' barycentric
        weights [T, 3] and the faces' indices [P]; face by face.
    """
    triangle, weights = _cell_texels(self.size)
    by_place = np.argsort(self.place)
    edge = self.cells * self.size
    texture = np.zeros((edge, edge, 3), np.uint8)
    for half in range(2):
      rows, columns = np.nonzero(triangle == half)
      faces = by_place[half::2]
      where = self.cell[faces][:, None] * self.size + np.stack([columns, rows], -1)  # [P, T, 2]
      colors = color(weights[rows, columns], faces)
      texture[where[..., 1].ravel(), where[..., 0].ravel()] = colors
    return texture


def _atlas(mesh: Mesh, *, texel: float) -> _Atlas:
  """Lays the faces out for texels of this edge on the mean face [m]."""
  corners = mesh.vertices[mesh.faces]  # [F, 3, 3]
  across = -(-len(mesh.faces) // 2)
  cells = int(np.ceil(np.sqrt(across)))
  inner = min(np.ceil(np.sqrt(2 * triangles.areas(corners).mean()) / texel), _MAX_SIZE)
  size = int(np.clip(inner + 4 * _BORDER, _MIN_CELL, max(_MAX_SIZE // cells, _MIN_CELL)))
  place = np.empty(len(mesh.faces), np.int64)
  place[_morton_order(corners.mean(1))] = np.arange(len(mesh.faces))
  return _Atlas(size, cells, place, _morton_grid(cells)[place // 2])


def bake(mesh: Mesh, views: fusion.DepthViews, *, texel: float = 0.012) -> TexturedMesh:
  """Bakes colours of the views into a texture.

  Args:
    mesh: The mesh, in the views' frame.
    views: Pictures with depth that see it.
    texel: Wanted edge of a texel on the mean face [m]; larger where the atlas would exceed 8192.

  Raises:
    ValueError: The views have no colour pictures.
  """
  corners, normals = mesh.vertices[mesh.faces], mesh.normals

  def color(weights: np.ndarray, faces: np.ndarray) -> np.ndarray:
    points = np.einsum("tk,fki->fti", weights, corners[faces])
    facing = np.einsum("tk,fki->fti", weights, normals[mesh.faces[faces]])
    facing /= np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-12)
    return point_colors(points.reshape(-1, 3), facing.reshape(-1, 3), views)

  atlas = _atlas(mesh, texel=texel)
  return TexturedMesh(mesh.vertices, mesh.faces, atlas.uv, atlas.fill(color))


def bake_vertex_colors(mesh: Mesh) -> TexturedMesh:
  """Bakes the vertices' colours into a texture, interpolated over each face.

  Raises:
    ValueError: The mesh has no colours.
  """
  if mesh.colors is None:
    raise ValueError("Baking needs a mesh with vertex colours, found none.")
  corners = mesh.colors[mesh.faces].astype(np.float64)

  def color(weights: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.einsum("tk,fki->fti", weights, corners[faces]).reshape(-1, 3).round()

  atlas = _atlas(mesh, texel=np.inf)
  return TexturedMesh(mesh.vertices, mesh.faces, atlas.uv, atlas.fill(color))


def _morton_grid(cells: int) -> np.ndarray:
  """Places (column, row) of the cells of a square atlas in Morton order [cells^2, 2]."""
  column, row = (axis.ravel() for axis in np.meshgrid(np.arange(cells), np.arange(cells)))
  code = np.zeros(len(column), np.int64)
  for bit in range(int(cells).bit_length()):
    code |= ((column >> bit) & 1) << (2 * bit)
    code |= ((row >> bit) & 1) << (2 * bit + 1)
  order = np.argsort(code, kind="stable")
  return np.stack([column[order], row[order]], -1)
