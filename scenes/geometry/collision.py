"""Makes the contact geometry of a scene: cropped, without floor, as convex parts in files.

The floor itself is not among the parts: the arena adds a plane at z = 0 (paper, section "Collision
mesh extraction": "we also replace the floor vertices in the mesh with a flat plane").
"""

import dataclasses
import pathlib
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy import ndimage

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.geometry import convex, decomposition, fusion, thin
from nerf2real.scenes.geometry import mesh as meshes


@dataclasses.dataclass(frozen=True, kw_only=True)
class CollisionSettings:
  """Settings of the contact geometry; lengths in metres."""

  voxel: float = 0.03
  """Edge of a voxel; a finer one costs time and finds noise."""
  truncation: float = 0.08
  """Matter is at least this thick behind a seen surface."""
  top: float = 1.5
  """Nothing above is needed: three times the height of the robot."""
  smoothing: float = 1.3
  """Standard deviation of the blur over voxels that takes off depth noise."""
  min_component: float = 0.15
  """Smaller floating pieces are dropped, diagonal of their box."""
  parts: decomposition.ConvexSettings = dataclasses.field(
    default_factory=decomposition.ConvexSettings
  )


_CORE = -0.2  # value, in truncations, below which a voxel is matter whatever its neighbours are


def remove_floor(grid: fusion.Grid, *, threshold: float) -> fusion.Grid:
  """Takes out the floor: below the threshold there is matter only under matter.

  What stands just above the threshold is extended down to z = 0, so that no ball rolls under a
  chest.
  """
  heights = grid.centres(2)
  layer = int(np.searchsorted(heights, threshold))
  ground = int(np.searchsorted(heights, 0.0))
  if layer >= len(heights):
    raise ValueError(
      f"The floor threshold {threshold:g} m is above the extent's top {heights[-1]:.2f} m."
    )
  values, weights = grid.values.copy(), grid.weights.copy()
  values[:, :, :layer] = grid.values[:, :, layer : layer + 1]
  weights[:, :, :layer] = grid.weights[:, :, layer : layer + 1]
  values[:, :, :ground] = 1.0
  return grid._replace(values=values, weights=weights)


def smooth(grid: fusion.Grid, *, deviation: float) -> fusion.Grid:
  """Blurs the observed values of a grid; unknown voxels neither give nor take.

  Voxels well inside matter stay matter: a blur alone would dissolve chair legs.

  Args:
    grid: The grid.
    deviation: Standard deviation of the blur [voxel]; 0 changes nothing.
  """
  if deviation <= 0:
    return grid
  known = grid.observed.astype(np.float32)
  share = ndimage.gaussian_filter(known, deviation)
  mean = ndimage.gaussian_filter(grid.values * known, deviation) / np.maximum(share, 1e-6)
  core = grid.values < _CORE
  values = np.where((known > 0) & ~core, mean, np.minimum(grid.values, np.where(core, mean, 1.0)))
  return grid._replace(values=values.astype(np.float32))


def solid_grid(
  views: fusion.DepthViews,
  *,
  lower: np.ndarray,
  upper: np.ndarray,
  floor_threshold: float,
  settings: CollisionSettings | None = None,
  progress: Progress = no_progress,
) -> fusion.Grid:
  """Fuses depth into the grid that collides: cropped, without floor and floaters, world frame.

  Args:
    views: Depth pictures in the world frame (metres, floor at z = 0).
    lower: Lower corner of the extent [3].
    upper: Upper corner of the extent [3].
    floor_threshold: Matter below counts as floor [m].
    settings: Settings.
    progress: Called with the fraction done and a text.
  """
  settings = settings or CollisionSettings()
  lower = np.array([lower[0], lower[1], 0.0])
  upper = np.array([upper[0], upper[1], min(upper[2], settings.top)])
  grid = fusion.fuse(
    views,
    lower=lower,
    upper=upper,
    voxel=settings.voxel,
    truncation=settings.truncation,
    progress=progress,
  )
  grid = thin.with_thin_things(smooth(grid, deviation=settings.smoothing), views)
  grid = remove_floor(grid, threshold=floor_threshold)
  return meshes.drop_floaters(grid, min_component=settings.min_component)


def write_parts(parts: Sequence[convex.Part], folder: pathlib.Path) -> None:
  """Writes part_000.obj, part_001.obj, ...; older parts in the folder are removed."""
  folder.mkdir(parents=True, exist_ok=True)
  for old in folder.glob("part_*.obj"):
    old.unlink()
  for number, part in enumerate(parts):
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in part.vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in part.faces + 1]
    path = folder / f"part_{number:03d}.obj"
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def read_parts(folder: pathlib.Path) -> list[convex.Part]:
  """Reads the parts of a bundle, sorted by name."""
  paths = sorted(folder.glob("part_*.obj"))
  if not paths:
    raise ValueError(f"Found no part_*.obj in {folder}: the bundle has no collision geometry.")
  parts = []
  for path in paths:
    rows = [line.split() for line in path.read_text(encoding="ascii").splitlines()]
    part = convex.hull(np.array([row[1:4] for row in rows if row and row[0] == "v"], np.float64))
    if part is None:
      raise ValueError(f"{path} is flat: a convex part needs volume.")
    parts.append(part)
  return parts


def spec(parts: Sequence[convex.Part], *, floor: bool = True) -> mujoco.MjSpec:
  """The parts as MuJoCo will collide them, with the floor plane, as a specification."""
  model = mujoco.MjSpec()
  if floor:
    model.worldbody.add_geom(
      name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], group=1
    )
  for number, part in enumerate(parts):
    name = f"part_{number:03d}"
    model.add_mesh(
      name=name,
      uservert=part.vertices.ravel(),
      userface=part.faces.ravel(),
      inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
    )
    model.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=0)
  return model
