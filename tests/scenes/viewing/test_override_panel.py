"""An override file from clicked points is in the frames that the alignment reads."""

import types

import numpy as np
import pytest
import viser
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.alignment import overrides, picking
from nerf2real.scenes.viewing.override_panel import OverridePanel, surface_point

_TRANSFORM = Similarity(
  2.5, Rotation.from_euler("zyx", [0.4, -0.3, 0.2]).as_matrix(), np.array([0.3, -0.2, 1.1])
)
_FLOOR = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.5, 0.0]])  # world


class _Plane:
  """Renders the world's floor z = 0 as the unit frame has it."""

  def render_rays(self, origins, directions, pixel_angle):
    start = _TRANSFORM.apply(origins)
    way = directions @ _TRANSFORM.rotation.T  # unit length in the world, too
    with np.errstate(divide="ignore"):
      distance = np.where(way[:, 2] < 0, -start[:, 2] / way[:, 2], np.inf)
    return None, distance / _TRANSFORM.scale, None


@pytest.fixture
def bundle():
  return types.SimpleNamespace(
    name="room",
    world_from_unit=_TRANSFORM,
    extent=(np.array([-1.0, -2.0, -0.1]), np.array([3.0, 4.0, 2.4])),
  )


@pytest.fixture
def panel(bundle, tmp_path):
  server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
  made = OverridePanel(server, bundle, _Plane())
  made.path.value = str(tmp_path / "deep" / "override.yaml")
  yield made
  server.stop()


def _click(panel, target):
  eye = np.array([0.5, -3.0, 2.0])
  event = types.SimpleNamespace(ray_origin=tuple(eye), ray_direction=tuple(target - eye))
  panel._click(event)


def test_a_ray_meets_the_surface_in_the_world(bundle):
  eye, target = np.array([0.5, -3.0, 2.0]), np.array([1.0, 0.5, 0.0])
  np.testing.assert_allclose(surface_point(_Plane(), bundle, eye, target - eye), target, atol=1e-9)
  assert surface_point(_Plane(), bundle, eye, np.array([0.0, 0.0, 1.0])) is None


def test_clicked_floor_and_distance_are_saved_in_the_unit_frame(panel, tmp_path):
  _click(panel, _FLOOR[0])
  assert panel.picked.points[picking.FLOOR] == []  # clicks turn the view until they are wanted
  panel._taking.value = True
  for point in _FLOOR:
    _click(panel, point)
  panel.purpose.value = picking.DISTANCE
  _click(panel, _FLOOR[0])
  _click(panel, _FLOOR[1])
  panel.distance.value = 1.9
  panel.save()
  assert "saved" in panel.status.content
  read = overrides.read(tmp_path / "deep" / "override.yaml")
  np.testing.assert_allclose(_TRANSFORM.apply(read.floor_points), _FLOOR, atol=1e-4)
  np.testing.assert_allclose(_TRANSFORM.apply(read.scale_points), _FLOOR[:2], atol=1e-4)
  assert read.scale_distance == 1.9


def test_an_extent_is_in_the_world_and_stands_alone(panel, tmp_path):
  panel._taking.value = True
  panel.purpose.value = picking.EXTENT
  for point in ([2.0, -1.0, 0.0], [-0.5, 3.0, 0.0]):
    _click(panel, np.array(point))
  assert panel.picked.values(distance=1.0) == {
    "extent_lower": [-0.5, -1.0, -0.1],
    "extent_upper": [2.0, 3.0, 2.4],
  }
  panel.purpose.value = picking.ORIGIN
  _click(panel, _FLOOR[0])
  panel.save()
  assert "not saved" in panel.status.content and "world frame" in panel.status.content
  assert not (tmp_path / "deep").exists()
  panel.remove_last()
  panel.save()
  assert overrides.read(tmp_path / "deep" / "override.yaml").origin is None


def test_too_few_points_are_not_saved(panel, tmp_path):
  panel._taking.value = True
  panel.save()
  assert "Nothing is picked" in panel.status.content
  _click(panel, _FLOOR[0])
  panel.save()
  assert "not saved" in panel.status.content and "at least three" in panel.status.content
  assert list(tmp_path.iterdir()) == []


def test_other_keys_of_an_older_file_stay_unless_they_contradict(tmp_path):
  path = tmp_path / "override.yaml"
  path.write_text("yaw_deg: 30\n")
  picking.save(path, {"origin": [0.1, 0.2, 0.3]})
  read = overrides.read(path)
  assert read.yaw_deg == 30 and read.origin.tolist() == [0.1, 0.2, 0.3]
  path.write_text("scale: 2\n")
  with pytest.raises(ValueError, match="both fix the scale"):
    picking.save(path, {"scale_points": [[0, 0, 0], [1, 0, 0]], "scale_distance": 2.0})
  assert path.read_text() == "scale: 2\n"
