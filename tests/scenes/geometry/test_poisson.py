"""Poisson meshes of sparse points, and the rasteriser that shows them against MuJoCo's rays."""

import mujoco
import numpy as np
import pytest

from nerf2real.core.geometry import cameras
from nerf2real.scenes.geometry import mesh, poisson
from tests.scenes import furnished_room

CAMERA = cameras.Camera(width=80, height=60, fx=70, fy=71, cx=40.5, cy=29.5, k1=-0.05, k2=0.01)


def test_sphere_of_sparse_points():
  rng = np.random.default_rng(0)
  direction = rng.standard_normal((1500, 3))
  direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
  colors = np.where(direction[:, :1] > 0, [[200, 20, 20]], [[20, 20, 200]]).astype(np.uint8)
  eyes = 4 * direction[:200]
  normals = poisson.estimate_normals(direction, eyes)
  assert np.median((normals * direction).sum(-1)) > 0.99
  found = poisson.poisson_mesh(direction, colors, camera_positions=eyes)
  radius = np.linalg.norm(found.vertices, axis=-1)
  assert np.percentile(np.abs(radius - 1), 95) < 0.03
  right = found.vertices[:, 0] > 0.3
  assert (found.colors[right, 0] > found.colors[right, 2]).mean() > 0.97


def test_too_few_points_are_named():
  with pytest.raises(ValueError, match="at least 50 points, found 3"):
    poisson.poisson_mesh(np.eye(3), np.zeros((3, 3), np.uint8), camera_positions=np.ones((1, 3)))


def test_rasteriser_agrees_with_rays():
  grid = np.linspace(-2.5, 2.5, 81)  # a bumpy ground of small triangles
  x, y = np.meshgrid(grid, grid, indexing="ij")
  vertices = np.stack([x, y, 0.2 * np.sin(2 * x) * np.cos(2 * y)], -1).reshape(-1, 3)
  a = (np.arange(80)[:, None] * 81 + np.arange(80)).ravel()
  faces = np.concatenate([np.stack([a, a + 81, a + 82], 1), np.stack([a, a + 82, a + 1], 1)])
  colors = np.clip(127 + 50 * vertices, 0, 255).astype(np.uint8)
  spec = mujoco.MjSpec()
  spec.add_mesh(
    name="m",
    uservert=vertices.ravel(),
    userface=faces.ravel(),
    inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
  )
  spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m")
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  pose = furnished_room.look_at([1.6, 0.2, 1.5], [-0.3, 0, 0])
  shown, depth = poisson.render_mesh(mesh.Mesh(vertices, faces, colors), CAMERA, pose)
  rays = CAMERA.rays().reshape(-1, 3)
  hit, expected = np.empty(len(rays), np.int32), np.empty(len(rays))
  mujoco.mj_multiRay(
    model,
    data,
    pose[:3, 3].copy(),
    (rays @ pose[:3, :3].T).ravel(),
    None,
    True,
    -1,
    hit,
    expected,
    None,
    len(rays),
    1e3,
  )
  expected = expected.reshape(depth.shape)
  both = np.isfinite(depth) & (hit.reshape(depth.shape) >= 0)
  assert (np.isfinite(depth) == (hit.reshape(depth.shape) >= 0)).mean() > 0.99
  assert both.mean() > 0.5
  assert np.percentile(np.abs(depth - expected)[both], 99) < 0.01
  points = pose[:3, 3] + expected[..., None] * (CAMERA.rays() @ pose[:3, :3].T)
  error = np.abs(shown.astype(float) - (127 + 50 * points))[both]
  assert np.percentile(error, 99) < 2.5
