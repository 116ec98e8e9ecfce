"""Bakes a texture for a triangle mesh from posed pictures.

Two triangles share a square cell of the atlas; cells follow a Morton curve through the room, so
that the averages that a renderer's mipmaps take over neighbouring cells are of neighbouring places.
Shapes: V vertices, F faces, K texels along a cell's edge.
"""

import dataclasses

import numpy as np

from nerf2real.scenes.geometry import fusion
from nerf2real.scenes.geometry.mesh import Mesh, point_colors

_BORDER = 1.0  # texels between a triangle and its cell's edge: bilinear reads stay inside the cell
_MORTON_BITS = 10  # an axis of the room is cut into 2^10 steps
_MAX_SIZE = 8192  # texels along the atlas; older GPUs take no more


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


def bake(mesh: Mesh, views: fusion.DepthViews, *, texel: float = 0.012) -> TexturedMesh:
  """Bakes colours of the views into a texture.

  Args:
    mesh: The mesh, in the views' frame.
    views: Pictures with depth that see it.
    texel: Wanted edge of a texel on the mean face [m]; larger where the atlas would exceed 8192.

  Raises:
    ValueError: The views have no colour pictures.
  """
  corners = mesh.vertices[mesh.faces]  # [F, 3, 3]
  areas = 0.5 * np.linalg.norm(
    np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
  )
  across = -(-len(mesh.faces) // 2)
  cells = int(np.ceil(np.sqrt(across)))
  inner = int(np.ceil(np.sqrt(2 * areas.mean()) / texel))
  size = int(np.clip(inner + 4 * _BORDER, 6, max(_MAX_SIZE // cells, 6)))
  place = np.empty(len(mesh.faces), np.int64)
  place[_morton_order(corners.mean(1))] = np.arange(len(mesh.faces))
  cell = _morton_grid(cells)[place // 2]  # [F, 2] column, row
  uv = (cell[:, None] * size + _cell_corners(size)[place % 2]) / (cells * size)
  uv[..., 1] = 1 - uv[..., 1]

  triangle, weights = _cell_texels(size)
  by_place = np.argsort(place)
  texture = np.zeros((cells * size, cells * size, 3), np.uint8)
  normals = mesh.normals
  for half in range(2):
    rows, columns = np.nonzero(triangle == half)
    blend = weights[rows, columns]  # [T, 3]
    faces = by_place[half::2]
    points = np.einsum("tk,fki->fti", blend, corners[faces])
    facing = np.einsum("tk,fki->fti", blend, normals[mesh.faces[faces]])
    facing /= np.maximum(np.linalg.norm(facing, axis=-1, keepdims=True), 1e-12)
    colors = point_colors(points.reshape(-1, 3), facing.reshape(-1, 3), views)
    where = cell[faces][:, None] * size + np.stack([columns, rows], -1)  # [F/2, T, 2]
    texture[where[..., 1].ravel(), where[..., 0].ravel()] = colors
  return TexturedMesh(mesh.vertices, mesh.faces, uv, texture)


def _morton_grid(cells: int) -> np.ndarray:
  """Places (column, row) of the cells of a square atlas in Morton order [cells^2, 2]."""
  column, row = (axis.ravel() for axis in np.meshgrid(np.arange(cells), np.arange(cells)))
  code = np.zeros(len(column), np.int64)
  for bit in range(int(cells).bit_length()):
    code |= ((column >> bit) & 1) << (2 * bit)
    code |= ((row >> bit) & 1) << (2 * bit + 1)
  order = np.argsort(code, kind="stable")
  return np.stack([column[order], row[order]], -1)
