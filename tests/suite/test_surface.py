"""`physics.render` shows the room, or says what it needs."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from nerf2real import suite
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.geometry.mesh import load_glb
from nerf2real.suite.op3 import op3

_DRAW = """
from nerf2real import suite
environment = suite.load("nerf_nav", image_size=None, random=0)
environment.reset()
try:
  environment.physics.render(24, 32)
except RuntimeError as error:
  print(error)
"""


@pytest.fixture(scope="module")
def shown():
  return suite.load("nerf_nav", image_size=None, random=3, surface=True)


def test_the_surface_collides_with_nothing_and_lies_in_the_room(shown):
  model = shown.physics.model.ptr
  geom = model.geom("surface")
  assert geom.contype == geom.conaffinity == 0
  assert geom.group == op3.FLOOR_GROUP  # drawn by default, unlike the convex parts
  mesh = model.mesh(int(geom.dataid[0]))
  assert mesh.facenum == len(load_glb(Bundle.load().visual_path).faces)
  lower, upper = Bundle.load().extent
  first = int(mesh.vertadr[0])
  vertices = model.mesh_vert[first : first + int(mesh.vertnum[0])]
  rotation = np.empty(9)
  mujoco.mju_quat2Mat(rotation, geom.quat)
  world = vertices @ rotation.reshape(3, 3).T + geom.pos
  assert (world.min(0) > lower - 0.1).all() and (world.max(0) < upper + 0.1).all()


def test_episodes_are_the_same_with_and_without(shown):
  plain = suite.load("nerf_nav", image_size=None, random=3)
  plain.reset(), shown.reset()
  for _ in range(5):
    action = plain.task.standing_action
    one, other = plain.step(action), shown.step(action)
  for name, value in one.observation.items():
    np.testing.assert_array_equal(value, other.observation[name])


def test_the_picture_has_the_rooms_colours():
  """In a process of its own: the backend is chosen when MuJoCo's wrapper is imported."""
  program = """
import numpy as np
from nerf2real import suite
for surface in (False, True):
  environment = suite.load("nerf_nav", image_size=None, random=0, surface=surface)
  environment.reset()
  picture = environment.physics.render(120, 160).reshape(-1, 3).astype(float)
  print(len(np.unique(picture // 16, axis=0)))
"""
  done = subprocess.run(
    [sys.executable, "-c", program],
    env=os.environ | {"MUJOCO_GL": "egl"},
    capture_output=True,
    text=True,
    timeout=300,
  )
  if "MuJoCo cannot draw" in done.stderr:
    pytest.skip("no EGL")
  plain, drawn = map(int, done.stdout.split())
  assert drawn > 4 * plain  # colours, of 4096


def test_without_opengl_one_line_says_what_to_set():
  done = subprocess.run(
    [sys.executable, "-c", _DRAW],
    env=os.environ | {"MUJOCO_GL": "disabled"},
    capture_output=True,
    text=True,
    timeout=300,
  )
  assert done.stdout.count("\n") == 1
  assert "MUJOCO_GL is disabled" in done.stdout and "MUJOCO_GL=egl" in done.stdout
