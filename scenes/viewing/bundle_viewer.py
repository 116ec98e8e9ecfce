"""A scene bundle in the browser, as layers: field, splats, meshes, parts, free floor, cameras."""

from typing import Any, NamedTuple

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation
from viser import transforms

from nerf2real.core import browser_view, palette
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.export.splats.splats import Splats
from nerf2real.scenes.export.views import capture_cameras, overlooking_view, renderer_of
from nerf2real.scenes.field.render import browser as field_view
from nerf2real.scenes.geometry.free_space import FreeSpaceMap
from nerf2real.scenes.geometry.mesh import load_glb
from nerf2real.scenes.viewing.override_panel import OverridePanel

_CAMERA_STEP = 3  # every third camera is drawn
_FLOOR_LIFT = 0.02  # of the free floor above the floor, or it would flicker with it [m]
_SETBACK = 0.04  # of the field's depth behind what stands on its surfaces [m]


class Layer(NamedTuple):
  """Something of the scene that is switched on and off as a whole."""

  label: str
  handles: list[Any]
  shown: bool  # at first


def _parts(server: viser.ViserServer, bundle: Bundle) -> list[Any]:
  """One mesh a colour: a browser draws eight meshes sooner than hundreds."""
  by_color: dict[palette.Rgb, list[trimesh.Trimesh]] = {}
  for index, path in enumerate(bundle.collision_parts):
    by_color.setdefault(palette.rgb(palette.cycle(index)), []).append(trimesh.load_mesh(path))
  handles = []
  for number, (color, parts) in enumerate(by_color.items()):
    joined: Any = trimesh.util.concatenate(parts)
    handles.append(
      server.scene.add_mesh_simple(
        f"/parts/{number}",
        joined.vertices,
        joined.faces,
        color=color,
        opacity=0.85,
        flat_shading=True,
      )
    )
  return handles


def _cameras(server: viser.ViserServer, bundle: Bundle) -> list[Any]:
  handles = []
  camera, poses, names = capture_cameras(bundle)
  for name, world in list(zip(names, poses, strict=True))[::_CAMERA_STEP]:
    handles.append(
      server.scene.add_camera_frustum(
        f"/cameras/{name}",
        fov=camera.vertical_fov,
        aspect=camera.width / camera.height,
        scale=0.08,
        wxyz=transforms.SO3.from_matrix(world[:3, :3]).wxyz,
        position=world[:3, 3],
        color=palette.rgb(palette.VERMILION),
        thickness=1.5,
        thickness_units="screen",
      )
    )
  return handles


def _rectangles(cells: np.ndarray) -> np.ndarray:
  """Rectangles [R, 4] that tile the true cells of a map [H, W]: first row and column, and the ends.

  Runs along the rows, of which equal ones in rows that follow each other are one rectangle.
  """
  edges = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
  row, start = np.nonzero(edges == 1)
  end = np.nonzero(edges == -1)[1]
  order = np.lexsort((row, end, start))
  row, start, end = row[order], start[order], end[order]
  ends = (np.diff(start) != 0) | (np.diff(end) != 0) | (np.diff(row) != 1)
  breaks = np.concatenate([[len(row) > 0], ends, [len(row) > 0]])
  first, last = np.nonzero(breaks)[0][:-1], np.nonzero(breaks)[0][1:] - 1
  return np.stack([row[first], start[first], row[last] + 1, end[first]], -1)


def free_floor_mesh(space: FreeSpaceMap, *, height: float) -> tuple[np.ndarray, np.ndarray]:
  """R rectangles over the reachable cells of a map: vertices [4 R, 3] [m] and faces [2 R, 3]."""
  corners = _rectangles(space.reachable)[:, [[1, 0], [3, 0], [3, 2], [1, 2]]]  # column, row
  places = space.origin + space.resolution * corners
  vertices = np.concatenate([places, np.full((*places.shape[:2], 1), height)], -1)
  first = 4 * np.arange(len(places))[:, None]
  faces = np.concatenate([first + np.array(three) for three in ([0, 1, 2], [0, 2, 3])])
  return vertices.reshape(-1, 3), faces


def _splats(server: viser.ViserServer, splats: Splats) -> list[Any]:
  spread = Rotation.from_quat(splats.rotations, scalar_first=True).as_matrix()
  spread = spread * splats.scales[:, None]
  shown = server.scene.add_gaussian_splats(
    "/splats",
    centers=splats.positions,
    covariances=spread @ spread.transpose(0, 2, 1),
    rgbs=np.clip(splats.colors, 0, 1),
    opacities=splats.opacities[:, None],
  )
  return [shown]


def _layers(server: viser.ViserServer, bundle: Bundle, splats: Splats | None) -> list[Layer]:
  """Adds everything but the field."""
  floor = server.scene.add_mesh_simple(
    "/free_floor",
    *free_floor_mesh(bundle.free_space, height=_FLOOR_LIFT),
    color=palette.rgb(palette.GREEN),
    opacity=0.5,
    side="double",
  )
  grid = server.scene.add_grid("/floor", width=8.0, height=8.0, cell_size=0.5)
  surface = server.scene.add_mesh_trimesh("/visual", load_glb(bundle.visual_path))
  found = [Layer("splats", _splats(server, splats), True)] if splats is not None else []
  return [
    *found,
    Layer("surface mesh", [surface], False),
    Layer("convex parts", _parts(server, bundle), False),
    Layer("free floor", [floor], False),
    Layer("cameras", _cameras(server, bundle), False),  # the view starts among them
    Layer("floor grid", [grid], True),
  ]


def _add_switches(server: viser.ViserServer, layers: list[Layer]) -> None:
  for layer in layers:
    switch = server.gui.add_checkbox(layer.label, layer.shown)
    for handle in layer.handles:
      handle.visible = layer.shown

    @switch.on_update
    def _(event, switch=switch, handles=layer.handles):
      for handle in handles:
        handle.visible = switch.value


def _add_figures(server: viser.ViserServer, bundle: Bundle) -> None:
  figures = [
    f"| {key} | {value:.4g} |" if isinstance(value, float) else f"| {key} | {value} |"
    for key, value in bundle.figures.items()
    if not isinstance(value, dict)
  ]
  with server.gui.add_folder("figures", expand_by_default=False):
    server.gui.add_markdown("\n".join(["| figure | value |", "| --- | --- |", *figures]))


def view_bundle(
  bundle: Bundle, *, host: str, port: int, splats: Splats | None = None
) -> viser.ViserServer:
  """Serves a bundle's viewer: layers that switch on and off; returns the running server.

  Args:
    bundle: The scene.
    host: Address to serve on.
    port: Port to serve on.
    splats: Shown beside the field, which starts switched off then.
  """
  server = browser_view.serve(f"scene {bundle.name}", host=host, port=port)
  server.scene.set_up_direction("+z")
  field_view.begin_as(server, *overlooking_view(bundle))
  renderer = renderer_of(bundle)
  view = field_view.FieldView(renderer, bundle.world_from_unit)
  field_view.serve_field(server, view, setback=_SETBACK, shown=splats is None)
  _add_switches(server, _layers(server, bundle, splats))
  _add_figures(server, bundle)
  OverridePanel(server, bundle, renderer)
  return server
