"""Writes the textured surface mesh as glTF binary: metres, y up, as glTF 2.0 prescribes."""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from nerf2real.core import files
from nerf2real.scenes.export.texture import TexturedMesh
from nerf2real.scenes.geometry.mesh import Y_UP


def textured_trimesh(mesh: TexturedMesh) -> trimesh.Trimesh:
  """Returns the mesh with a material of the baked light: no shading of its own is wanted."""
  material = trimesh.visual.material.PBRMaterial(
    name="baked",
    baseColorTexture=Image.fromarray(mesh.texture),
    metallicFactor=0.0,
    roughnessFactor=1.0,
  )
  corners = mesh.faces.ravel()
  return trimesh.Trimesh(
    mesh.vertices[corners],
    np.arange(len(corners)).reshape(-1, 3),
    visual=trimesh.visual.TextureVisuals(uv=mesh.uv.reshape(-1, 2), material=material),
    process=False,
  )


def write(path: Path, mesh: TexturedMesh) -> None:
  """Writes a mesh of the world frame (z up) as a .glb file, turned to y up."""
  shown = textured_trimesh(mesh)
  shown.vertices = shown.vertices @ Y_UP.T
  scene = trimesh.Scene(metadata={"unit": "metre", "up": "y"})
  scene.add_geometry(shown, geom_name="visual", node_name="visual")
  content = scene.export(file_type="glb")
  assert isinstance(content, bytes)  # other formats give text or a mapping
  files.write_atomically(path, content)
