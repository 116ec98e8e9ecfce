"""A scene bundle in the browser: its field, meshes, convex parts and the capture's cameras."""

import os

import numpy as np
import trimesh
import viser
from viser import transforms

from nerf2real.core import palette
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render import browser as field_view
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.geometry.mesh import load_glb
from nerf2real.scenes.poses import localise

_CAMERA_STEP = 3  # every third camera is drawn


def _add_scene(server: viser.ViserServer, bundle: Bundle) -> None:
  """Adds meshes, parts, cameras and the free-space map, each with a switch."""
  shown = server.scene.add_mesh_trimesh("/visual", load_glb(bundle.visual_path))
  shown.visible = False
  parts = []
  for index, path in enumerate(bundle.collision_parts):
    part = trimesh.load_mesh(path)
    parts.append(
      server.scene.add_mesh_simple(
        f"/parts/{index:03d}",
        part.vertices,
        part.faces,
        color=palette.rgb(palette.cycle(index)),
        opacity=0.85,
        flat_shading=True,
      )
    )
    parts[-1].visible = False
  frusta = []
  sfm = localise.load(bundle.folder / "sfm")
  for name, pose in list(zip(sfm.names, sfm.world_from_camera, strict=True))[::_CAMERA_STEP]:
    world = bundle.world_from_unit.apply_pose(pose)
    frusta.append(
      server.scene.add_camera_frustum(
        f"/cameras/{name}",
        fov=sfm.camera.vertical_fov,
        aspect=sfm.camera.width / sfm.camera.height,
        scale=0.08,
        wxyz=transforms.SO3.from_matrix(world[:3, :3]).wxyz,
        position=world[:3, 3],
        color=(213, 94, 0),
        thickness=0.004,
      )
    )
    frusta[-1].visible = False  # the view starts among them
  grid = server.scene.add_grid("/floor", width=8.0, height=8.0, cell_size=0.5)

  for label, handles, on in (
    ("surface mesh", [shown], False),
    ("convex parts", parts, False),
    ("cameras", frusta, False),
    ("floor grid", [grid], True),
  ):
    switch = server.gui.add_checkbox(label, on)

    @switch.on_update
    def _(event, switch=switch, handles=handles):
      for handle in handles:
        handle.visible = switch.value

  figures = [
    f"| {key} | {value:.4g} |" if isinstance(value, float) else f"| {key} | {value} |"
    for key, value in bundle.figures.items()
    if not isinstance(value, dict)
  ]
  with server.gui.add_folder("figures", expand_by_default=False):
    server.gui.add_markdown("\n".join(["| figure | value |", "| --- | --- |", *figures]))


def _overlooking_camera(bundle: Bundle) -> tuple[np.ndarray, np.ndarray]:
  """Position and direction [3] of the capture's camera that had most of the room before it.

  From where nothing was filmed the field is fog.
  """
  poses = localise.load(bundle.folder / "sfm").world_from_camera
  world = bundle.world_from_unit.apply_pose(poses)
  eyes, forward = world[:, :3, 3], world[:, :3, 2]
  depth = np.einsum("ni,ni->n", 0.5 * sum(bundle.extent) - eyes, forward)
  best = int(np.argmax(depth))
  return eyes[best], forward[best]


def view_bundle(bundle: Bundle, *, host: str, port: int) -> viser.ViserServer:
  """Serves a bundle's viewer; returns the running server."""
  server = viser.ViserServer(host=host, port=port, label=f"scene {bundle.name}", verbose=False)
  server.scene.set_up_direction("+z")
  eye, forward = _overlooking_camera(bundle)
  server.initial_camera.position = tuple(eye)
  server.initial_camera.look_at = tuple(eye + forward)
  renderer = Renderer(Field.load(bundle.field_path), threads=os.cpu_count() or 1)
  field_view.serve_field(server, field_view.FieldView(renderer, bundle.world_from_unit))
  _add_scene(server, bundle)
  return server
