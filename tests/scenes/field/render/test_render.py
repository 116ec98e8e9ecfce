"""The renderer against the JAX reference, OpenCV's projection and shapes known in closed form."""

import concurrent.futures
import dataclasses
import pickle

import cv2
import numpy as np
import pytest
import warp as wp

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.field.field import Field, FieldSettings
from nerf2real.scenes.field.occupancy import Occupancy
from nerf2real.scenes.field.render import renderer as render
from tests.scenes import analytic_fields
from tests.scenes.field.render import reference as render_reference

BALL = np.array([0.5, 0.3, 0.8])
MATTER = 192.4  # density [1/unit] of analytic matter: 10 squareplus(3 * 64 / sqrt(63) - 5)
LENS = Camera(
  width=64, height=48, fx=50.0, fy=52.0, cx=31.0, cy=25.0, k1=-0.25, k2=0.06, p1=0.01, p2=-0.008
)
FINE = render.RenderSettings(step=0.004, steps_per_footprint=4.0, near=0.0, stop=0.02)


def _soft_field(**settings) -> Field:
  shape = FieldSettings(base_resolution=16, growth=1.5, **settings)
  return analytic_fields.from_signed_distance(
    lambda p: np.abs(np.linalg.norm(p, axis=-1) - 0.8) - 0.1, settings=shape, slope=8.0, texture=0.3
  )


def _random_rays(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
  random = np.random.default_rng(seed)
  origins = random.uniform(-0.4, 0.4, (count, 3)).astype(np.float32)
  directions = random.normal(size=(count, 3)).astype(np.float32)
  return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def ball() -> render.Renderer:
  field = analytic_fields.from_signed_distance(
    lambda p: np.linalg.norm(p - BALL, axis=-1) - 0.15,
    settings=FieldSettings(levels=1, log2_table_size=18, base_resolution=62),
  )
  return render.Renderer(field, settings=FINE)


@pytest.fixture(scope="module")
def wall() -> render.Renderer:
  """Matter behind z = 0.6 and behind x = 0.7."""
  field = analytic_fields.from_signed_distance(
    lambda p: np.maximum(0.6 - p[..., 2], -10.0) + 0 * p[..., 0]
  )
  return render.Renderer(field, settings=FINE)


@pytest.mark.parametrize(
  ("shape", "angle"),
  [
    ({"levels": 8, "log2_table_size": 14}, 0.002),
    ({"levels": 8, "log2_table_size": 14}, 0.03),
    ({"levels": 9, "log2_table_size": 13, "bottleneck": 7, "view_width": 16}, 0.01),
    ({"levels": 3, "log2_table_size": 15, "width": 32}, 0.02),
  ],
)
def test_agrees_with_the_jax_reference(shape, angle):
  field = _soft_field(**shape)
  # Random cells, inside and outside the unit cube, make every kind of skip happen.
  occupied = np.random.default_rng(0).random((32, 32, 32)) < 0.15
  occupancy = Occupancy.from_occupied(occupied)
  settings = render.RenderSettings(
    step=0.012, stop=0.0, weight_floor=0.0, far=5.0, specular_per_sample=True
  )
  renderer = render.Renderer(field, settings=settings, occupancy=occupancy)
  origins, directions = _random_rays(200)
  color, distance, opacity = renderer.render_rays(origins, directions, angle)
  expected_color, expected_distance, expected_opacity = render_reference.render_rays(
    field, occupancy, origins, directions, pixel_angle=angle, settings=settings
  )
  # A sample may fall on the other side of a cell's wall in float32: a few rays may differ.
  error = np.abs(color - expected_color).max(-1)
  assert np.percentile(error, 98) < 1e-2
  assert np.median(error) < 2e-3
  assert np.percentile(np.abs(opacity - expected_opacity), 98) < 1e-2
  assert 0.05 < np.mean(expected_opacity > 0.5) < 1
  np.testing.assert_array_equal(np.isinf(distance), ~(opacity > 0.5))
  both = np.isfinite(distance) & np.isfinite(expected_distance)
  # The median jumps where a ray is half transparent over a long way.
  assert np.percentile(np.abs(distance[both] - expected_distance[both]), 80) < 0.5 * settings.step


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.35, 0.0), (-0.4, 0.3), (0.4, -0.25)])
def test_a_ball_appears_where_opencv_projects_it(ball, angles):
  yaw, pitch = angles
  rotation = cv2.Rodrigues(np.array([0, yaw, 0.0]))[0] @ cv2.Rodrigues(np.array([pitch, 0, 0.0]))[0]
  forward = BALL / np.linalg.norm(BALL)
  right = np.cross([0, 1.0, 0], forward)
  right /= np.linalg.norm(right)
  pose = np.eye(4)
  pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1) @ rotation
  pose[:3, 3] = [-0.05, 0.02, -0.1]
  _, depth = ball.render(LENS, pose)
  seen = np.argwhere(np.isfinite(depth))[:, ::-1] + 0.5
  assert len(seen) > 30
  # The outline of the ball: the circle where rays from the camera touch it.
  centre = BALL - pose[:3, 3]
  gap = np.linalg.norm(centre)
  sine = 0.15 / gap
  side = np.linalg.svd(centre[None])[2][1:]
  turn = np.linspace(0, 2 * np.pi, 60)[:, None]
  circle = (
    BALL
    - centre * sine**2
    + 0.15 * np.sqrt(1 - sine**2) * (np.cos(turn) * side[0] + np.sin(turn) * side[1])
  )
  camera_from_unit = np.linalg.inv(pose)
  # OpenCV's pixel centres are whole numbers, the camera's are halves.
  outline, _ = cv2.projectPoints(
    circle,
    cv2.Rodrigues(camera_from_unit[:3, :3])[0],
    camera_from_unit[:3, 3],
    LENS.matrix - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]],
    LENS.distortion,
  )
  outline = outline[:, 0] + 0.5
  middle = (outline.max(0) + outline.min(0)) / 2
  np.testing.assert_allclose((seen.max(0) + seen.min(0)) / 2, middle, atol=0.8)
  area = cv2.contourArea(outline.astype(np.float32))
  assert abs(len(seen) - area) < 0.12 * area


def test_depth_is_that_of_a_plane_and_along_z(wall):
  _, depth = wall.render(LENS, np.eye(4))
  half = np.log(2) / MATTER  # light falls to one half this far behind the surface
  slant = np.linalg.norm(LENS.rays(), axis=-1)
  assert np.abs(depth - (0.6 + half / slant)).max() < 0.5 * FINE.step
  tilted = np.eye(4)
  tilted[:3, :3] = cv2.Rodrigues(np.array([0.2, 0, 0]))[0]
  _, depth = wall.render(LENS, tilted)
  rays = LENS.rays() @ tilted[:3, :3].T
  assert np.abs(depth - (0.6 / rays[..., 2] + half / slant)).max() < 0.5 * FINE.step


def test_nothing_gives_infinite_depth_and_black(wall):
  away = np.diag([1.0, -1.0, -1.0, 1.0])
  color, depth = wall.render(LENS, away)
  assert np.all(np.isinf(depth))
  assert color.max() == 0
  nothing = Occupancy.from_occupied(np.zeros((16, 16, 16), bool))
  empty = render.Renderer(wall.field, occupancy=nothing)
  assert np.all(np.isinf(empty.render(LENS, np.eye(4))[1]))


def test_early_stop_and_weight_floor_change_little():
  field = _soft_field(levels=4, log2_table_size=14)
  exact = dataclasses.replace(render.RenderSettings(), stop=0.0, weight_floor=0.0, far=4.0)
  slow = render.Renderer(field, settings=exact)
  settings = dataclasses.replace(exact, stop=0.02, weight_floor=0.004)
  fast = render.Renderer(field, settings=settings, occupancy=slow.occupancy)
  origins, directions = _random_rays(300)
  expected_color, expected_distance, _ = slow.render_rays(origins, directions, 0.01)
  color, distance, _ = fast.render_rays(origins, directions, 0.01)
  assert 0 < np.abs(color - expected_color).max() < 0.04
  np.testing.assert_allclose(distance, expected_distance, atol=1e-5)


def test_one_specular_colour_a_ray_is_close_to_one_a_sample():
  field = _soft_field(levels=4, log2_table_size=14)
  each = render.Renderer(field, settings=render.RenderSettings(far=4.0))
  once = render.RenderSettings(specular_per_sample=False, far=4.0)
  mean = render.Renderer(field, settings=once, occupancy=each.occupancy)
  origins, directions = _random_rays(300)
  expected, expected_distance, _ = each.render_rays(origins, directions, 0.01)
  color, distance, _ = mean.render_rays(origins, directions, 0.01)
  # The field is random, far rougher than a trained one.
  error = np.abs(color - expected)
  assert 0 < error.mean() < 0.02
  np.testing.assert_array_equal(distance, expected_distance)


def test_batches_threads_and_rays_agree_with_single_pictures(wall):
  poses = np.stack([np.eye(4)] * 6)
  poses[:, 0, 3] = np.linspace(-0.3, 0.3, 6)
  singles = [wall.render(LENS, pose) for pose in poses]
  color, depth = wall.render_batch(LENS, poses)
  with concurrent.futures.ThreadPoolExecutor(3) as pool:
    threaded = list(pool.map(lambda pose: wall.render(LENS, pose), poses))
  for i in range(6):
    np.testing.assert_array_equal(color[i], singles[i][0])
    np.testing.assert_array_equal(depth[i], singles[i][1])
    np.testing.assert_array_equal(threaded[i][0], singles[i][0])
  shared = render.Renderer(wall.field, settings=FINE, occupancy=wall.occupancy, threads=3)
  np.testing.assert_array_equal(shared.render_batch(LENS, poses)[0], color)
  rays = LENS.rays().reshape(-1, 3)
  slant = np.linalg.norm(rays, axis=-1)
  origins = np.broadcast_to(poses[1, :3, 3], rays.shape)
  ray_color, distance, opacity = wall.render_rays(origins, rays / slant[:, None], LENS.pixel_angle)
  np.testing.assert_allclose(distance / slant, singles[1][1].ravel(), rtol=1e-4)
  ray_pixels = np.clip(ray_color, 0, 1).reshape(48, 64, 3) * 255
  np.testing.assert_allclose(ray_pixels, singles[1][0], atol=0.6)
  assert opacity.min() > 0.97


def test_reference_picture_agrees(wall):
  camera = LENS.resized(16, 12)
  settings = dataclasses.replace(FINE, far=2.0)
  expected = render_reference.render_picture(
    wall.field, wall.occupancy, camera, np.eye(4), settings=settings
  )
  color, depth = wall.render(camera, np.eye(4))
  assert np.abs(color.astype(int) - expected[0]).max() <= 3
  np.testing.assert_allclose(depth, expected[1], atol=FINE.step)


def test_wrong_input_is_refused(wall):
  with pytest.raises(ValueError, match="unit length"):
    wall.render_rays(np.zeros((2, 3)), np.full((2, 3), 2.0), 0.01)
  with pytest.raises(ValueError, match=r"poses \[N, 4, 4\]"):
    wall.render(LENS, np.eye(3))
  with pytest.raises(ValueError, match="stop"):
    render.RenderSettings(stop=0.7)
  with pytest.raises(ValueError, match="2 features"):
    render.Renderer(Field(FieldSettings(features=4), {}, 0.002))
  assert pickle.loads(pickle.dumps(FINE)) == FINE


def test_cuda_agrees_with_cpu_or_is_refused(wall):
  if not wp.is_cuda_available():
    with pytest.raises(ValueError, match="No CUDA device"):
      render.Renderer(wall.field, device="cuda")
    pytest.skip("no CUDA device")
  gpu = render.Renderer(wall.field, settings=FINE, occupancy=wall.occupancy, device="cuda")
  color, depth = gpu.render(LENS, np.eye(4))
  expected_color, expected_depth = wall.render(LENS, np.eye(4))
  assert np.abs(color.astype(int) - expected_color).max() <= 2
  np.testing.assert_allclose(depth, expected_depth, atol=1e-3)
