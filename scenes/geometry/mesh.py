"""Extracts the scene's surface mesh: marching cubes, without floaters, coloured, as glTF.

The surface is that of fused depth pictures (`scenes.geometry.fusion`). The paper takes the field's
density at a threshold (section "Collision mesh extraction"); fusion needs no threshold, which
depends on how long the field was trained, and keeps out of space that no ray reached.
Shapes: V vertices, F faces, X, Y, Z voxels.
"""

import dataclasses
import pathlib
from typing import NamedTuple

import numpy as np
import trimesh
from scipy import ndimage, sparse
from skimage import measure

from nerf2real.scenes.geometry import fusion

_FIELD_OF_VIEW = 1.5  # tangent; farther out a lens polynomial may fold back into the picture
_SAME_DEPTH = 0.04  # relative; a point this far behind the seen depth is hidden
_UNSEEN_GREY = 128  # colour of points that no view sees


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeshSettings:
  """Settings of the surface and of the mesh shown to people."""

  voxel: float = 0.025
  """Edge of a voxel [m]; half of what the collision may be wrong by."""
  truncation: float = 0.075
  """Band in which views are averaged [m]; 3 voxels."""
  min_component: float = 0.3
  """Smaller floating pieces are dropped [m], diagonal of their box."""
  visual_faces: int = 60_000
  """Faces of visual.glb after decimation."""


class Mesh(NamedTuple):
  """A triangle mesh."""

  vertices: np.ndarray  # float64 [V, 3]
  faces: np.ndarray  # int [F, 3]
  colors: np.ndarray | None = None  # uint8 [V, 3]

  @property
  def normals(self) -> np.ndarray:
    """Unit normals of the vertices [V, 3], weighted by the faces' areas."""
    a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros_like(self.vertices)
    for i in range(3):
      np.add.at(total, self.faces[:, i], face)
    return total / np.maximum(np.linalg.norm(total, axis=-1, keepdims=True), 1e-12)


def surface(grid: fusion.Grid) -> Mesh:
  """Marching cubes over the observed cells of a grid: only surface that was seen.

  Source: Lorensen and Cline 1987, Marching cubes.

  Raises:
    ValueError: the grid holds no surface.
  """
  known = grid.observed
  # A cell counts where its eight corners are known; skimage looks it up at its last corner.
  cell = np.ones_like(known)
  for offset in np.ndindex(2, 2, 2):
    shifted = np.zeros_like(known)
    target = tuple(slice(o, n) for n, o in zip(known.shape, offset, strict=True))
    source = tuple(slice(0, n - o) for n, o in zip(known.shape, offset, strict=True))
    shifted[target] = known[source]
    cell &= shifted
  if not (cell.any() and grid.values[known].min() < 0 < grid.values[known].max()):
    raise ValueError(
      "Found no surface in the grid: the depth pictures show nothing inside the extent. "
      "Check the extent, the scale and the field."
    )
  vertices, faces, _, _ = measure.marching_cubes(grid.values, 0.0, mask=cell)
  return Mesh(vertices * grid.voxel + grid.lower, faces.astype(np.int64))


def drop_floaters(grid: fusion.Grid, *, min_component: float) -> fusion.Grid:
  """Sets free every connected piece of matter whose box has a shorter diagonal."""
  labels, count = ndimage.label(grid.solid, structure=np.ones((3, 3, 3)))
  if count == 0:
    return grid
  small = np.zeros(count + 1, bool)
  for i, box in enumerate(ndimage.find_objects(labels)):
    diagonal = np.linalg.norm([s.stop - s.start for s in box]) * grid.voxel
    small[i + 1] = diagonal < min_component
  return grid._replace(values=np.where(small[labels], np.float32(1), grid.values))


def drop_small_pieces(mesh: Mesh, *, min_component: float) -> Mesh:
  """Removes connected pieces of a mesh whose bounding box has a shorter diagonal."""
  count = len(mesh.vertices)
  edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
  links = sparse.coo_matrix((np.ones(len(edges), bool), edges.T), shape=(count, count))
  pieces, label = sparse.csgraph.connected_components(links, directed=False)
  low, high = np.full((pieces, 3), np.inf), np.full((pieces, 3), -np.inf)
  np.minimum.at(low, label, mesh.vertices)
  np.maximum.at(high, label, mesh.vertices)
  keep = (np.linalg.norm(high - low, axis=-1) >= min_component)[label]
  index = np.cumsum(keep) - 1
  return Mesh(
    mesh.vertices[keep],
    index[mesh.faces[keep[mesh.faces[:, 0]]]],
    None if mesh.colors is None else mesh.colors[keep],
  )


def simplify(mesh: Mesh, *, faces: int) -> Mesh:
  """Decimates to about this many faces (quadric error); colours are lost, paint afterwards."""
  if len(mesh.faces) <= faces:
    return mesh
  import fast_simplification  # only where scenes are made

  vertices, triangles = fast_simplification.simplify(
    mesh.vertices.astype(np.float32),
    mesh.faces.astype(np.int32),
    target_reduction=1 - faces / len(mesh.faces),
  )
  return Mesh(vertices.astype(np.float64), triangles.astype(np.int64))


def paint(mesh: Mesh, views: fusion.DepthViews) -> Mesh:
  """Colours every vertex with the mean of the views that see it, see `point_colors`."""
  return mesh._replace(colors=point_colors(mesh.vertices, mesh.normals, views))


def point_colors(points: np.ndarray, normals: np.ndarray, views: fusion.DepthViews) -> np.ndarray:
  """Colours uint8 [P, 3] of surface points [P, 3] with unit normals [P, 3], from the views.

  A colour is the mean of the views that see a point, weighted by cosine over squared distance. A
  view sees a point if its depth picture agrees within 4 % of the depth. Points that no view sees
  take mid grey.

  Raises:
    ValueError: The views have no colour pictures.
  """
  if views.color is None:
    raise ValueError("Painting a mesh needs views with colour pictures, found depth only.")
  camera = views.camera
  total = np.zeros((len(points), 4))
  for pose, depth, color in zip(views.frame_from_camera, views.depth, views.color, strict=True):
    away = pose[:3, 3] - points
    local = -away @ pose[:3, :3]
    distance = np.linalg.norm(away, axis=-1)
    facing = (away * normals).sum(-1) / distance
    index = np.flatnonzero((facing > 0.1) & (local[:, 2] > 1e-6))
    index = index[(np.abs(local[index, :2]) < _FIELD_OF_VIEW * local[index, 2:]).all(-1)]
    column, row = np.floor(camera.project(local[index])).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    index, column, row = index[inside], column[inside], row[inside]
    seen = np.abs(depth[row, column] - local[index, 2]) < _SAME_DEPTH * local[index, 2]
    index, column, row = index[seen], column[seen], row[seen]
    weight = facing[index] / distance[index] ** 2
    total[index] += weight[:, None] * np.c_[color[row, column], np.ones(len(index))]
  known = total[:, 3] > 0
  colors = np.full((len(points), 3), _UNSEEN_GREY, np.uint8)
  colors[known] = np.round(total[known, :3] / total[known, 3:])
  return colors


Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float64)  # glTF's axes from the world's


def save_glb(mesh: Mesh, path: pathlib.Path) -> None:
  """Writes a glTF binary with vertex colours and normals; y up, as glTF prescribes.

  Without normals the standard asks for flat faces.
  """
  shown = trimesh.Trimesh(
    mesh.vertices @ Y_UP.T, mesh.faces, vertex_colors=mesh.colors, process=False
  )
  content = shown.export(file_type="glb", include_normals=True)
  assert isinstance(content, bytes)  # other formats give text or a mapping
  path.write_bytes(content)


def load_glb(path: pathlib.Path) -> trimesh.Trimesh:
  """Reads what `save_glb` wrote, turned back to z up, with vertex normals computed.

  Raises:
    ValueError: No such file.
  """
  if not path.is_file():
    raise ValueError(f"The surface mesh {path} does not exist: make the bundle again.")
  shown = trimesh.load_mesh(path, process=False)
  shown.vertices = shown.vertices @ Y_UP
  shown.vertex_normals  # noqa: B018  trimesh passes on what it has computed: smooth shading
  return shown
