"""The spectator's view: it stands in the clear, looks at the robot and shows it in the scene."""

import mujoco
import numpy as np
import pytest

from nerf2real import suite
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.views import third_person
from tests.suite.synthetic import FlatRenderer, make_room

_HEIGHT, _WIDTH = 120, 160


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
  room = make_room(tmp_path_factory.mktemp("room"))
  off = RandomisationSettings(torso_mass=False, pushes=False)
  return suite.load("nerf_nav", scene=room, renderer=FlatRenderer(), random=0, randomisation=off)


def _stand(environment, x, y, yaw=0.0):
  environment.task.set_start(Pose(x, y, yaw))
  environment.reset()
  return third_person.ThirdPerson(
    environment.task, environment.physics, height=_HEIGHT, width=_WIDTH
  )


@pytest.mark.parametrize("yaw", [0.0, 1.5, 3.0, -1.5])
@pytest.mark.parametrize("place", [(0.0, 0.0), (-2.8, -2.3), (-2.8, 2.3), (2.6, 0.9)])
def test_nothing_of_the_room_stands_before_the_robot(environment, place, yaw):
  _stand(environment, *place, yaw)
  physics, position = environment.physics, environment.task.state.position
  angles = third_person.best_angles(environment.task, physics)
  way = third_person.direction(angles)
  assert np.linalg.norm(way) == pytest.approx(1.0)
  distance = third_person.clear_distance(physics, position, way)
  camera = position + distance * way
  assert (np.abs(camera[:2]) < (3.0, 2.5)).all()  # within the walls
  assert distance == pytest.approx(1.4)  # everywhere here some direction is free
  scene = np.array([0, 0, 0, 1, 0, 0], np.uint8)
  hit = mujoco.mj_ray(
    physics.model.ptr, physics.data.ptr, camera, -way, scene, 1, -1, np.zeros(1, np.int32)
  )
  assert hit < 0 or hit > distance


def test_the_view_is_about_where_the_capture_looked_from(environment, monkeypatch):
  _stand(environment, 0.0, 0.0)
  task, physics = environment.task, environment.physics
  assert third_person.best_angles(task, physics)[1] == pytest.approx(np.deg2rad(22.0))
  wanted = np.array([2.2, np.deg2rad(50.0)])
  way = third_person.direction(wanted)
  views = (task.state.position + 1.4 * way)[None], -way[None]
  monkeypatch.setattr(type(task.scene), "views", views, raising=False)
  found = third_person.direction(third_person.best_angles(task, physics))
  assert np.arccos(found @ way) < np.deg2rad(180 / 24) + 1e-6  # as near as is tried


def test_the_view_comes_nearer_where_a_wall_is_in_the_way(environment):
  _stand(environment, -2.6, 0.0)
  position = environment.task.state.position
  way = third_person.direction(np.array([np.pi, np.deg2rad(22.0)]))  # towards the wall at x = -3
  distance = third_person.clear_distance(environment.physics, position, way)
  to_wall = (position[0] + 3.0) / np.cos(np.deg2rad(22.0))
  assert distance == pytest.approx(max(0.3, to_wall - 0.15), abs=1e-6)


def test_the_view_turns_where_a_wall_would_bring_it_near(environment):
  """The robot walks to the wall that the view stood before; it stays whole in the picture."""
  view = _stand(environment, 1.0, 0.0)
  state = environment.task.state
  view._angles = view._wanted = np.array([np.pi, np.deg2rad(22.0)])  # towards the wall at x = -3
  near, edge = [], []
  for x in np.arange(1.0, -2.75, -0.02):  # m a frame: 0.4 m/s
    state.position[:2] = x, 0.0
    pose = view._follow()
    seen = (np.linalg.inv(pose) @ np.append(state.position, 1.0))[:3]
    near.append(seen[2])
    edge.append(np.abs(seen[:2]).max() / seen[2])
  assert min(near) > 0.9 and max(edge) < 0.22
  assert np.cos(view._wanted[0]) > np.cos(np.deg2rad(120))  # along the wall, or away from it


def test_look_at_is_upright_and_centred():
  position, target = np.array([1.0, -2.0, 1.5]), np.array([0.3, 0.4, 0.2])
  pose = third_person.look_at(position, target)
  np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
  assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
  seen = np.linalg.inv(pose) @ np.append(target, 1.0)
  np.testing.assert_allclose(seen[:2], 0.0, atol=1e-12)
  assert seen[2] > 0 and pose[2, 0] == pytest.approx(0.0) and pose[2, 1] < 0  # y points down


def test_the_robot_is_in_the_middle_and_hidden_by_what_is_nearer(environment):
  renderer = environment.task.robot_camera._renderer
  scale = environment.task.scene.world_from_unit.scale
  renderer.color = (40, 80, 120)
  seen = {}
  for depth in (3.0, 1.0):  # m: behind the robot, and before it
    renderer.depth = depth / scale
    picture = _stand(environment, 0.0, 0.0).draw()
    assert picture.shape == (_HEIGHT, _WIDTH, 3) and picture.dtype == np.uint8
    seen[depth] = np.argwhere((picture != (40, 80, 120)).any(axis=-1))
  renderer.depth = np.inf
  assert not len(seen[1.0])
  rows, columns = seen[3.0].mean(axis=0)
  assert len(seen[3.0]) > 200
  assert columns == pytest.approx(_WIDTH / 2, abs=8) and rows == pytest.approx(_HEIGHT / 2, abs=15)


def test_a_shadow_lies_on_the_floor_under_the_robot(environment):
  view = _stand(environment, 0.0, 0.0)
  pose = third_person.look_at(np.array([0.0, -0.5, 1.2]), np.array([0.0, 0.0, 0.0]))
  depth = -pose[2, 3] / (view._rays @ pose[:3, :3].T)[:, 2]  # the plane z = 0
  shape = (view._lens.height, view._lens.width)  # smaller than the picture
  lit = np.full((*shape, 3), 200, np.uint8)
  shaded = view._shadow(lit, depth.reshape(shape), pose)[..., 0]
  middle = int(shaded[shape[0] // 2, shape[1] // 2])
  assert middle == pytest.approx(100, abs=3)  # half of the light directly below
  assert shaded[0, 0] == 200
  raised = view._shadow(lit, 0.8 * depth.reshape(shape), pose)  # 24 cm above the floor
  assert (raised == 200).all()


def test_an_environment_without_pictures_is_refused(environment):
  blind = suite.load("nerf_nav", scene=environment.task.scene, image_size=None)
  with pytest.raises(ValueError, match="image_size"):
    third_person.ThirdPerson(blind.task, blind.physics, height=10, width=10)
