"""What the stages of geometry make of depth pictures, against an analytic room."""

import dataclasses
import types

import numpy as np

from nerf2real.core.geometry import cameras
from nerf2real.scenes.geometry import collision, floor_plan, mesh
from nerf2real.scenes.stages import geometry
from nerf2real.scenes.stages.cache import Made, Stages
from tests.scenes import furnished_room

_CAMERA = cameras.Camera(width=112, height=84, fx=87, fy=87.5, cx=56.5, cy=41.2)
_EXTENT = np.array([-2.7, -2.2, 0.0]), np.array([2.7, 2.2, 2.4])


def test_the_surface_holds_the_floor(tmp_path):
  """The floor is where the extent ends: noise puts half of it below."""
  views = furnished_room.depth_views(
    furnished_room.walk(48), _CAMERA, noise=0.004, rng=np.random.default_rng(0)
  )
  grey = np.full((*views.depth.shape, 3), 128, np.uint8)
  place = types.SimpleNamespace(extent_lower=_EXTENT[0], extent_upper=_EXTENT[1])
  earlier = types.SimpleNamespace(made="earlier")
  made = geometry.surface(
    Stages(tmp_path, show_progress=False),
    Made(place, earlier),
    Made(dataclasses.replace(views, color=grey), earlier),
    mesh.MeshSettings(),
  )
  found = mesh.load_glb(made.folder / "visual.glb")
  centres = found.triangles_center
  open_floor = (np.abs(centres[:, 0]) < 1.5) & (np.abs(centres[:, 1] + 0.3) < 0.6)
  level = (centres[:, 2] < 0.05) & (found.face_normals[:, 2] > 0.7)
  covered = found.area_faces[open_floor & level].sum()
  assert 0.8 < covered / (3.0 * 1.2) < 1.1


def test_a_thing_without_floor_to_walk_on_is_a_scene(tmp_path):
  views = furnished_room.depth_views(furnished_room.walk(8), _CAMERA)
  lower, upper = _EXTENT
  place = types.SimpleNamespace(extent_lower=lower, extent_upper=upper, floor_threshold=0.04)
  earlier = types.SimpleNamespace(made="earlier")
  made = geometry.contact(
    Stages(tmp_path, show_progress=False),
    Made(place, earlier),
    Made(views, earlier),
    collision.CollisionSettings(voxel=0.15, truncation=0.3),
    floor_plan.FreeSpaceSettings(radius=5.0),
  )
  assert made.value.parts and made.value.floor.area_m2 == 0 and not len(made.value.floor.goals)
