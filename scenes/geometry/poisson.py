"""The paper's baseline: a Poisson mesh of the structure-from-motion points, shown with its colours.

Paper, appendix "COLMAP details": "we reconstruct a dense mesh from the sparse results using the
Poisson mesher with the default settings". Sparse points carry no normals, so they are estimated
from neighbours and turned towards the cameras. Of the default settings two cannot stay: trim = 10
removes the whole mesh, because sparse points reach a density of 4 to 6 only, so faces far from any
point are removed instead; and depth = 13 makes the mesh of 9 in ten times the time. Shapes: P
points, F faces, H height, W width.
"""

import pathlib
import tempfile

import numba
import numpy as np
import trimesh
from scipy import spatial

from nerf2real.core.geometry import cameras
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.geometry.mesh import Mesh

_NEIGHBOURS = 16  # points that a normal is estimated from
_MIN_POINTS = 50
_DEPTH = 9  # of the octree; sparse points fill no finer cells
_FAR = 0.15  # faces farther from any point are removed; share of the points' median distance
_NEAR = 1e-3  # corners nearer than this to the image plane are not drawn [unit]


def estimate_normals(points: np.ndarray, camera_positions: np.ndarray) -> np.ndarray:
  """Unit normals [P, 3] of points [P, 3]: least variance of the neighbours, towards the cameras.

  Which cameras saw a point is not used: it is turned to the nearest one.
  """
  _, index = spatial.cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
  patches = points[index] - points[index].mean(1, keepdims=True)
  _, vectors = np.linalg.eigh(np.einsum("pki,pkj->pij", patches, patches))
  normals = vectors[:, :, 0]
  _, nearest = spatial.cKDTree(camera_positions).query(points)
  towards = camera_positions[nearest] - points
  return normals * np.where((normals * towards).sum(-1) < 0, -1.0, 1.0)[:, None]


def _write_ply(path: pathlib.Path, points, normals, colors) -> None:
  """Writes what COLMAP's Poisson mesher reads: binary points with normals and colours."""
  kind = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
  rows = np.empty(len(points), kind)
  rows["xyz"], rows["normal"], rows["rgb"] = points, normals, colors
  fields = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
  fields += [f"property uchar {name}" for name in ("red", "green", "blue")]
  header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *fields]
  path.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode("ascii") + rows.tobytes())


def poisson_mesh(points: np.ndarray, colors: np.ndarray, *, camera_positions: np.ndarray) -> Mesh:
  """Meshes sparse points with COLMAP's Poisson mesher at its default settings.

  Args:
    points: Sparse points [P, 3].
    colors: Their colours uint8 [P, 3].
    camera_positions: Camera centres [N, 3].

  Raises:
    ValueError: too few points, or the mesher made nothing of them.
  """
  if len(points) < _MIN_POINTS:
    raise ValueError(
      f"A Poisson mesh needs at least {_MIN_POINTS} points, found {len(points)}: film more texture."
    )
  with tempfile.TemporaryDirectory() as folder:
    source, target = pathlib.Path(folder, "points.ply"), pathlib.Path(folder, "mesh.ply")
    _write_ply(source, points, estimate_normals(points, camera_positions), colors)
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim = _DEPTH, 0.0
    pycolmap.poisson_meshing(source, target, options)
    if not target.is_file():
      raise ValueError(f"COLMAP's Poisson mesher made no mesh of {len(points)} points.")
    made = trimesh.load(target, process=False)
  if not isinstance(made, trimesh.Trimesh) or not len(made.faces):
    raise ValueError(f"COLMAP's Poisson mesher made an empty mesh of {len(points)} points.")
  vertices = np.asarray(made.vertices, np.float64)
  distance, nearest = spatial.cKDTree(points).query(vertices)
  size = np.median(np.linalg.norm(points - np.median(points, axis=0), axis=-1))
  faces = np.asarray(made.faces, np.int64)
  faces = faces[(distance < _FAR * size)[faces].all(-1)]
  if isinstance(made.visual, trimesh.visual.ColorVisuals) and made.visual.kind == "vertex":
    rgb = np.asarray(made.visual.vertex_colors)[:, :3].astype(np.uint8)
  else:  # the mesher dropped the colours: take those of the nearest points
    rgb = colors[nearest]
  return Mesh(vertices, faces, rgb)


@numba.njit(cache=True)
def _rasterise(pixels, depth, faces, colors, picture, zbuffer):
  height, width = zbuffer.shape
  for f in range(len(faces)):
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    za, zb, zc = depth[i], depth[j], depth[k]
    if za < _NEAR or zb < _NEAR or zc < _NEAR:
      continue
    ax, ay = pixels[i, 0], pixels[i, 1]
    bx, by = pixels[j, 0], pixels[j, 1]
    cx, cy = pixels[k, 0], pixels[k, 1]
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == 0:
      continue
    left, right = min(ax, bx, cx), max(ax, bx, cx)
    top, bottom = min(ay, by, cy), max(ay, by, cy)
    if right < 0 or bottom < 0 or left > width or top > height:
      continue
    for row in range(max(0, int(np.floor(top))), min(height, int(np.ceil(bottom)) + 1)):
      y = row + 0.5
      for column in range(max(0, int(np.floor(left))), min(width, int(np.ceil(right)) + 1)):
        x = column + 0.5
        u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
        v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
        w = 1 - u - v
        if u < 0 or v < 0 or w < 0:
          continue
        inverse = u / za + v / zb + w / zc  # 1 / z is linear on the picture
        z = 1 / inverse
        if z < zbuffer[row, column]:
          zbuffer[row, column] = z
          for c in range(3):
            value = u / za * colors[i, c] + v / zb * colors[j, c] + w / zc * colors[k, c]
            picture[row, column, c] = value * z


def render_mesh(
  mesh: Mesh, camera: cameras.Camera, frame_from_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Draws a mesh with vertex colours through a camera's lens.

  Corners are projected with the distortion, edges between them are straight: small triangles show
  it right. Triangles that reach behind the camera are left out.

  Args:
    mesh: With colours.
    camera: The camera.
    frame_from_camera: Its pose [4, 4] in the mesh's frame.

  Returns:
    Colour uint8 [H, W, 3], black where there is no mesh, and z-depth float32 [H, W], there inf.
  """
  if mesh.colors is None:
    raise ValueError("Drawing a mesh needs vertex colours, found none.")
  local = (mesh.vertices - frame_from_camera[:3, 3]) @ frame_from_camera[:3, :3]
  rays = camera.rays()
  reach = 1.3 * np.abs(rays[..., :2]).max()  # beyond, a lens polynomial may fold back
  safe = np.maximum(local[:, 2:], _NEAR)
  plane = np.clip(local[:, :2] / safe, -3 * reach, 3 * reach)
  inside = (np.abs(plane) < reach).all(-1)
  pixels = plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]
  pixels[inside] = camera.project(np.column_stack([plane[inside], np.ones(inside.sum())]))
  picture = np.zeros((camera.height, camera.width, 3), np.float32)
  zbuffer = np.full((camera.height, camera.width), np.inf, np.float32)
  colors = mesh.colors.astype(np.float32)
  _rasterise(pixels, local[:, 2].copy(), mesh.faces, colors, picture, zbuffer)
  return np.clip(np.round(picture), 0, 255).astype(np.uint8), zbuffer
