"""Convex parts of an analytic room, judged in MuJoCo: contacts, rays, distances."""

import mujoco
import numpy as np
import pytest

from nerf2real.core.geometry import cameras
from nerf2real.scenes.geometry import collision, convex, decomposition, floor_plan, fusion
from nerf2real.scenes.quality import collision_error
from tests.scenes import furnished_room

LOWER, UPPER = np.array([-2.62, -2.12, 0.0]), np.array([2.62, 2.12, 2.6])
SETTINGS = collision.CollisionSettings(voxel=0.04)
STANDING = np.array([[0.0, 0.0], [-1.2, 0.3], [0.0, -1.0], [1.5, -0.9]])  # places known to be free


@pytest.fixture(scope="module")
def views():
  camera = cameras.Camera.from_vertical_fov(0.95, 128, 96)
  return furnished_room.depth_views(
    furnished_room.walk(60), camera, noise=0.003, rng=np.random.default_rng(0)
  )


@pytest.fixture(scope="module")
def grid(views):
  return collision.solid_grid(
    views, lower=LOWER, upper=UPPER, floor_threshold=0.04, settings=SETTINGS
  )


@pytest.fixture(scope="module")
def parts(grid):
  return decomposition.decompose(grid)


def test_parts_are_few_and_convex(grid, parts):
  rough = decomposition.decompose(grid, settings=decomposition.ConvexSettings(tolerance=0.025))
  assert 10 < len(rough) <= 160
  for part in [*rough, *parts]:
    height = part.vertices @ part.planes[:, :3].T + part.planes[:, 3]
    assert height.max() < 1e-6
    assert len(part.vertices) <= 48


def test_a_ball_touches_what_the_room_says(parts):
  """MuJoCo contacts of a ball at random places against the true distance to the room."""
  model = collision.spec(parts)
  radius = 0.1
  ball = model.worldbody.add_body(name="ball")
  ball.add_freejoint()
  ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], mass=0.1)
  compiled = model.compile()
  data = mujoco.MjData(compiled)
  rng = np.random.default_rng(0)
  places = rng.uniform([-2.49, -1.99, 0.15], [2.49, 1.99, 0.42], (900, 3))  # below the unseen table
  away = np.array([x for x in places if not (0.4 < x[0] < 2.0 and 0.4 < x[1] < 1.6)])
  distance = furnished_room.distance(away)
  outside = np.all(
    [(np.abs(away - p) > s).any(-1) for p, s in furnished_room.FURNITURE.values()], axis=0
  )
  touching = []
  for place in away:
    data.qpos[:3] = place
    mujoco.mj_forward(compiled, data)
    touching.append(data.ncon > 0)
  touching = np.array(touching)
  clear = outside & (distance > radius + 0.05)
  near = outside & (distance < radius - 0.05)
  assert clear.sum() > 200 and near.sum() > 40
  assert touching[clear].mean() < 0.02
  assert touching[near].mean() > 0.95
  assert touching[~outside].mean() > 0.8


def test_walls_enclose_without_filling(parts):
  """From the middle of the room MuJoCo's rays meet the walls where they are."""
  model = collision.spec(parts).compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  geom = np.zeros(1, np.int32)
  for direction, expected in (
    ([1, 0, 0.0], 2.5),
    ([0, -1, 0.0], 2.0),
    ([0, 1, 0.0], 2.0),
    ([-1, -0.02, 0], 2.5),
  ):
    d = np.array(direction, float)
    found = mujoco.mj_ray(model, data, [0.0, -0.5, 0.45], d, None, 1, -1, geom)
    start = -0.5 if d[1] else 0.0
    assert found == pytest.approx(
      expected - np.sign(d[1]) * start if d[1] in (1, -1) else 2.5, abs=0.05
    )


def test_errors_both_ways(parts, views):
  eyes = np.concatenate([views.positions[::6], np.column_stack([STANDING, np.full(4, 0.3)])])
  surface, _ = views.surface_points(stride=2)
  top = np.array([*UPPER[:2], 1.4])
  found = collision_error.collision_error(
    parts, surface, eyes=eyes, lower=LOWER, upper=top, distance_to_surface=furnished_room.distance
  )
  assert found.parts_to_surface_median < 0.02 and found.surface_to_parts_median < 0.02
  assert found.surface_to_parts_p95 < 0.05
  assert found.parts_within_5cm > 0.93  # the table's underside was never seen
  by_points = collision_error.collision_error(parts, surface, eyes=eyes, lower=LOWER, upper=top)
  assert by_points.parts_to_surface_median == pytest.approx(
    found.parts_to_surface_median, abs=0.008
  )


def test_error_of_parts_moved_by_ten_centimetres(parts, views):
  """The measure itself: a known shift of every part shows up in both directions."""
  shift = np.array([0.1, 0.1, 0.1]) / np.sqrt(3)
  moved = [convex.hull(part.vertices + shift) for part in parts]
  surface, _ = views.surface_points(stride=3)
  found = collision_error.collision_error(
    moved, surface, eyes=views.positions[::6], lower=LOWER, upper=np.array([*UPPER[:2], 1.4])
  )
  assert 0.04 < found.parts_to_surface_median < 0.11
  assert found.parts_within_5cm < 0.6


def test_free_space_of_the_room(parts, grid):
  ground = floor_plan.floor_plan(parts, lower=LOWER, upper=UPPER, seen=grid)
  assert ground.is_reachable(STANDING).all()
  blocked = np.array(
    [[-0.9, -1.2], [-2.3, 0.6], [2.45, 0.0], [0.56, 0.56]]
  )  # box, shelf, wall, leg
  assert not ground.is_reachable(blocked).any()
  area = ground.area
  assert 8 < area < 15


def test_floor_is_taken_out_and_matter_stands_on_the_ground(views):
  grid = collision.solid_grid(
    views, lower=LOWER, upper=UPPER, floor_threshold=0.04, settings=SETTINGS
  )
  column = grid.solid[int((0.0 - LOWER[0]) / 0.04), int((0.0 - LOWER[1]) / 0.04)]
  assert not column[:20].any()  # bare floor
  i, j = (
    int((-0.9 - LOWER[0]) / 0.04),
    int((-1.08 - LOWER[1]) / 0.04),
  )  # within the box's north side
  assert grid.solid[i, j : j + 3, 0].any()
  with pytest.raises(ValueError, match="above the extent"):
    collision.remove_floor(grid, threshold=5.0)
  with pytest.raises(ValueError, match="no matter"):
    decomposition.decompose(grid._replace(values=np.ones_like(grid.values)))


def test_files_round_trip(parts, tmp_path):
  (tmp_path / "part_999.obj").write_text("stale")
  collision.write_parts(parts, tmp_path)
  paths = sorted(tmp_path.glob("*.obj"))
  assert len(paths) == len(parts)
  again = collision.read_parts(tmp_path)
  for a, b in zip(parts, again, strict=True):
    assert b.volume == pytest.approx(a.volume, rel=1e-2)
  # MuJoCo reads the files themselves.
  assets = {p.name: p.read_bytes() for p in paths}
  meshes = "".join(f'<mesh name="{p.stem}" file="{p.name}"/>' for p in paths)
  model = mujoco.MjModel.from_xml_string(
    f"<mujoco><asset>{meshes}</asset><worldbody/></mujoco>", assets
  )
  assert model.nmesh == len(parts)
  with pytest.raises(ValueError, match=r"no part_\*\.obj"):
    collision.read_parts(tmp_path / "empty")


def test_smoothing_takes_off_noise_and_leaves_the_unknown_alone():
  rng = np.random.default_rng(0)
  plane = np.broadcast_to(np.linspace(-1, 1, 21), (20, 20, 21)).astype(np.float32)
  weights = np.ones(plane.shape, np.float32)
  weights[:5] = 0
  noisy = plane + 0.1 * rng.normal(size=plane.shape).astype(np.float32)
  noisy[:5] = 1.0
  grid = fusion.Grid(noisy, weights, np.zeros(3), 0.03, 0.08)
  smooth = collision.smooth(grid, deviation=1.0).values
  np.testing.assert_array_equal(smooth[:5], 1.0)
  inner = (slice(5, None), slice(None), slice(3, -3))
  near = np.abs(plane[inner]) < 0.11  # what is well inside matter is kept as it was
  before, after = (noisy[inner] - plane[inner])[near], (smooth[inner] - plane[inner])[near]
  assert after.std() < 0.6 * before.std()
  assert collision.smooth(grid, deviation=0.0) is grid
