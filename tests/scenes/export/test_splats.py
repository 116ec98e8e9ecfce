"""Splats: their derivatives, their file in a foreign reader, their start, their fit."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.rooms.splats import draw_with_mujoco_warp
from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.builtin import ground_truth
from nerf2real.scenes.export.splats import fitting, projection, rasteriser, start
from nerf2real.scenes.export.splats.splats import Splats
from nerf2real.scenes.quality import image_quality
from tests.scenes import furnished_room
from tests.scenes.export import splat_projection

CAMERA = Camera(width=20, height=16, fx=18.0, fy=18.0, cx=10.0, cy=8.0)


def _parameters(rng, count):
  points = start.Seeds(
    positions=rng.uniform([-1, -1, 2], [1, 1, 4], (count, 3)),
    normals=rng.normal(size=(count, 3)),
    colors=rng.uniform(size=(count, 3)),
    spacing=np.full(count, 0.5),
  )
  return points


def test_derivatives_are_those_of_finite_differences():
  rng = np.random.default_rng(3)
  points = _parameters(rng, 6)
  rows, starts = start.rows_of(points), points.positions
  rows[:, 3:6] += 1.5  # so wide that no pixel comes and goes with a finite step
  eye = projection.Eye.at(CAMERA, np.eye(4))
  weights = rng.normal(size=(16, 20, 3))
  found, bounds = projection.project(rows, starts, points.spacing, eye)
  tiles = rasteriser.assign(bounds, width=20, height=16)
  gaussians = projection.Projected(*(np.array(array, np.float64) for array in found))
  drawn = rasteriser.composite(tiles, gaussians, width=20, height=16)
  slopes = rasteriser.composite_backward(gaussians, drawn, weights)
  for kind, slope in zip(projection.Projected._fields, slopes, strict=True):
    values = getattr(gaussians, kind)
    for index in np.ndindex(values.shape):
      step = 1e-7 * abs(values[index]) + 1e-8  # few pixels change the order of their splats
      ends = []
      for sign in (-1, 1):
        moved = values.copy()
        moved[index] += sign * step
        changed = gaussians._replace(**{kind: moved})
        image = rasteriser.composite(tiles, changed, width=20, height=16).image
        ends.append((image * weights).sum())
      expected = (ends[1] - ends[0]) / (2 * step)
      assert slope[index] == pytest.approx(expected, rel=2e-3, abs=2e-4 * np.abs(slope).max())


def _posed():
  pose = np.eye(4)
  pose[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
  pose[:3, 3] = 0.1, -0.2, 0.3
  return projection.Eye.at(CAMERA, pose)


def test_projection_and_its_derivatives_are_those_of_jax():
  rng = np.random.default_rng(5)
  points = _parameters(rng, 40)
  points.positions[:, :2] *= 1.5  # some far outside the picture
  rows = start.rows_of(points)
  rows += rng.normal(0, 0.3, rows.shape).astype(np.float32)
  arguments = rows, points.positions, points.spacing, _posed()
  found, bounds = projection.project(*arguments)
  ahead = bounds.depths > 0
  assert ahead.sum() > 30
  exact = (rows[ahead].astype(np.float64), points.positions[ahead], points.spacing[ahead], _posed())
  with jax.enable_x64():
    for mine, theirs in zip(found, splat_projection.project(*exact), strict=True):
      np.testing.assert_allclose(mine[ahead], theirs, rtol=2e-4, atol=1e-5)
    slopes = projection.Projected(*(rng.normal(size=array.shape) for array in found))
    chosen = projection.Projected(*(slope[ahead] for slope in slopes))
    expected = np.asarray(splat_projection.pull(*exact, chosen))
  gradient = projection.pull(*arguments, slopes)
  np.testing.assert_allclose(
    gradient[ahead], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max()
  )
  assert not gradient[~ahead].any()
  behind = points.positions - [0, 0, 9]
  assert (projection.project(rows, behind, *arguments[2:])[1].depths == 0).all()
  assert not projection.pull(rows, behind, *arguments[2:], slopes).any()


def test_a_picture_is_that_of_every_splat_on_every_ray():
  """Response along the ray, order along the ray, and the faint ones: without tiles or boxes."""
  rng = np.random.default_rng(8)
  points = _parameters(rng, 60)
  rows = start.rows_of(points)
  rows += rng.normal(0, 0.3, rows.shape).astype(np.float32)
  arguments = points.positions, points.spacing, _posed()
  found, bounds = projection.project(rows, *arguments)
  ahead = bounds.depths > 0
  tiles = rasteriser.assign(bounds, width=20, height=16)
  image = rasteriser.composite(tiles, found, width=20, height=16).image
  with jax.enable_x64():
    exact = rows[ahead].astype(np.float64), points.positions[ahead], points.spacing[ahead]
    expected = splat_projection.render(*exact, _posed(), width=20, height=16)
  np.testing.assert_allclose(image, expected, atol=0.006)  # what a full pixel leaves out


def test_a_round_splat_covers_what_its_size_says():
  """A ball of 0.1 m at 2 m: a ray is full once it passes at the distance of the deviation."""
  row = np.array([[0.0, 0, 0, *np.log([0.1] * 3), 0.3, 0.1, -0.7, 0.2, 0, 1, 1, 1]])
  eye = projection.Eye.at(CAMERA, np.eye(4))
  found, bounds = projection.project(row, np.array([[0.0, 0.0, 2.0]]), np.ones(1), eye)
  np.testing.assert_allclose(found.centres, [[10.0, 8.0]], atol=1e-5)
  sine = 0.1 / 2.0  # of the angle between the ray that touches the ball and that to its centre
  offset = 18 * sine / np.sqrt(1 - sine**2)
  power = 0.5 * found.conics[0, 0] * offset**2 / (1 + found.bends[0, 2] * offset**2)
  assert power == pytest.approx(0.5, rel=1e-4)
  np.testing.assert_allclose(found.conics[0, 1], 0.0, atol=1e-5)
  assert float(bounds.depths[0]) == pytest.approx(2.0)
  faintest = np.sqrt(2 * np.log(0.5 / projection.FAINTEST)) * sine
  reach = 18 * faintest / np.sqrt(1 - faintest**2)
  np.testing.assert_allclose(
    bounds.boxes[0], [10 - reach, 10 + reach, 8 - reach, 8 + reach], rtol=1e-4
  )


def test_the_file_opens_with_plyfile(tmp_path):
  plyfile = pytest.importorskip("plyfile")
  rng = np.random.default_rng(0)
  rotations = rng.normal(size=(7, 4))
  splats = Splats(
    positions=rng.normal(size=(7, 3)),
    rotations=rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
    scales=rng.uniform(0.01, 0.1, (7, 3)),
    opacities=rng.uniform(0.1, 0.9, 7),
    colors=rng.uniform(size=(7, 3)),
  )
  splats.save_ply(tmp_path / "room.ply")
  vertex = plyfile.PlyData.read(str(tmp_path / "room.ply"))["vertex"]
  np.testing.assert_allclose(
    np.stack([vertex[axis] for axis in "xyz"], 1), splats.positions, rtol=1e-6
  )
  np.testing.assert_allclose(
    np.exp([vertex[f"scale_{k}"] for k in range(3)]).T, splats.scales, rtol=1e-5
  )
  np.testing.assert_allclose(1 / (1 + np.exp(-vertex["opacity"])), splats.opacities, rtol=1e-5)
  np.testing.assert_allclose(0.5 + 0.28209479 * vertex["f_dc_1"], splats.colors[:, 1], rtol=1e-5)
  content = (tmp_path / "room.ply").read_bytes()
  for lost in (68, 30):
    (tmp_path / "cut.ply").write_bytes(content[:-lost])
    with pytest.raises(ValueError, match=r"cut\.ply is cut or damaged: found .* expected"):
      Splats.load_ply(tmp_path / "cut.ply")
  again = Splats.load_ply(tmp_path / "room.ply")
  np.testing.assert_allclose(again.rotations, splats.rotations, atol=1e-6)


def test_another_renderer_draws_the_file_as_ours_does(tmp_path):
  pytest.importorskip("mujoco_warp")
  rng = np.random.default_rng(5)
  fit = fitting.Fit(_parameters(rng, 300))
  fit.rows[:, :-3] += rng.normal(0, 0.3, (300, fit.rows.shape[1] - 3))
  fit.splats.save_ply(tmp_path / "room.ply")
  pose = np.eye(4)
  pose[:3, 3] = 0.2, -0.1, 0.3
  ours = (255 * fit.render(ground_truth.robot_camera(60, 80), pose)).round().astype(np.uint8)
  drawn = draw_with_mujoco_warp(Splats.load_ply(tmp_path / "room.ply"), pose[None], samples=1)
  # both leave out what is faint, each by its own bound
  assert image_quality.psnr(drawn[0], ours) > 40


def _views(size):
  camera = Camera.from_vertical_fov(0.9, size[1], size[0])
  poses = furnished_room.walk(6)
  views = furnished_room.depth_views(poses, camera)
  points = poses[:, None, None, :3, 3] + np.einsum(
    "nij,nhwj->nhwi", poses[:, :3, :3], camera.rays() * views.depth[..., None]
  )
  color = 127 + 100 * np.sin(points * [2.0, 3.0, 4.0])
  return dataclasses.replace(views, color=color.astype(np.uint8))


def test_splats_start_on_the_surface_and_are_finer_where_seen_from_near():
  views = _views((24, 32))
  points = start.thin_to(start.seeds(views, far=10.0, spacing=1.0), count=2500, finest=0.02)
  assert 1000 < len(points.positions) <= 2500
  assert np.percentile(furnished_room.distance(points.positions), 95) < 0.02
  eyes = views.positions
  nearest = np.linalg.norm(points.positions[:, None] - eyes, axis=-1).min(1)
  near, far = nearest < np.quantile(nearest, 0.2), nearest > np.quantile(nearest, 0.8)
  assert points.spacing[near].mean() < 0.8 * points.spacing[far].mean()


def test_a_short_fit_brings_the_pictures_nearer():
  views = _views((24, 32))
  assert views.color is not None
  points = start.thin_to(start.seeds(views, far=10.0, spacing=1.5), count=1500, finest=0.03)
  fit = fitting.Fit(points)
  errors = [
    fit.step(views.camera, views.frame_from_camera[k % 6], views.color[k % 6] / 255.0)
    for k in range(90)
  ]
  before, after = (-10 * np.log10(np.mean(part)) for part in (errors[:6], errors[-6:]))
  assert after > before + 5 and after > 28
