"""Puts a bundle's surface mesh into a task's model, so that `physics.render` shows the room.

Nothing collides with the mesh, and the robot's camera does not see it: that renders the radiance
field. Its colours are baked into a texture, since MuJoCo's meshes have none at their vertices.
"""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from dm_control import mjcf

from nerf2real.scenes.export.texture import TexturedMesh, bake_vertex_colors
from nerf2real.scenes.geometry.mesh import Mesh, load_glb
from nerf2real.suite.op3 import op3

_NAME = "surface"
_LIFT = 0.02  # m above the floor's plane, which would hide the mesh's floor
_EMISSION = 0.5  # share of the colours that needs no light: they are of the lit room


def add_surface(root: Any, path: Path) -> None:
  """Adds the mesh as a geom that collides with nothing.

  Args:
    root: The arena's MJCF model.
    path: The bundle's visual.glb.

  Raises:
    ValueError: The bundle has no such file.
  """
  shown: Any = load_glb(path)
  colors = np.asarray(shown.visual.vertex_colors)[:, :3]
  vertices, faces = np.asarray(shown.vertices), np.asarray(shown.faces)
  baked = bake_vertex_colors(Mesh(vertices, faces, colors))
  written, picture = cv2.imencode(".png", baked.texture[..., ::-1])
  assert written
  asset = root.asset
  asset.add("texture", name=_NAME, type="2d", file=mjcf.Asset(picture.tobytes(), ".png"))
  asset.add("material", name=_NAME, texture=_NAME, specular=0, shininess=0, emission=_EMISSION)
  content = _msh(baked, np.asarray(shown.vertex_normals))
  asset.add("mesh", name=_NAME, file=mjcf.Asset(content, ".msh"), inertia="shell")
  root.worldbody.add(
    "geom",
    name=_NAME,
    type="mesh",
    mesh=_NAME,
    material=_NAME,
    pos=(0, 0, _LIFT),
    contype=0,
    conaffinity=0,
    group=op3.FLOOR_GROUP,
  )


def _msh(mesh: TexturedMesh, normals: np.ndarray) -> bytes:
  """Returns a mesh in MuJoCo's binary format, three vertices a face; `normals` [V, 3] unit.

  Source: MuJoCo's XML reference, asset/mesh, "MSH file format".
  """
  corners = mesh.faces.ravel()
  uv = mesh.uv.reshape(-1, 2) * [1, -1] + [0, 1]  # this format counts from the picture's top
  parts = [mesh.vertices[corners], normals[corners], uv]
  count = len(corners)
  header = struct.pack("<4i", count, count, count, len(mesh.faces))
  body = b"".join(part.astype("<f4").tobytes() for part in parts)
  return header + body + np.arange(count, dtype="<i4").tobytes()
