"""What the baseline is made anew for."""

import types
from typing import Any

import numpy as np

from nerf2real.scenes.stages import judging
from nerf2real.scenes.stages.cache import Stages
from tests.scenes import box_views


def _pictures(width: int) -> Any:
  views = box_views.make_views(8, width=width, height=3 * width // 4, anchors=100)
  found = types.SimpleNamespace(
    points=np.zeros((1, 3)), point_colors=np.zeros((1, 3)), world_from_camera=np.eye(4)[None]
  )
  return types.SimpleNamespace(
    held_out_every=8,
    width=width,
    poses=types.SimpleNamespace(value=found, stamp="here"),
    held_out=lambda: views.split(8)[1],
  )


def test_pictures_of_another_size_make_the_baseline_anew(tmp_path, monkeypatch):
  monkeypatch.setattr(judging.poisson_meshes, "poisson_mesh", lambda *args, **options: None)
  monkeypatch.setattr(
    judging.poisson_meshes,
    "render_mesh",
    lambda mesh, camera, pose: (np.zeros((camera.height, camera.width, 3), np.uint8), None),
  )
  cache = Stages(tmp_path, show_progress=False)
  cached = [judging.baseline(cache, _pictures(width)).stage.cached for width in (64, 64, 32)]
  assert cached == [False, True, False]
