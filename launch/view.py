"""Shows a scene bundle, or a task in it, in the browser.

python launch/view.py out/livingroom
python launch/view.py --task nerf_nav
"""

import dataclasses
import os
import sys
import threading
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
import tyro
import viser
from viser import transforms

from scenes import localise
from scenes.bundle import Bundle
from scenes.cameras import Camera
from scenes.field import Field
from scenes.render import Renderer
from scenes.report_parts import part_color

_MOVING_WIDTH = 160  # pixels of a picture while the view moves
_STILL_WIDTHS = (320, 640, 960)  # pixels of the pictures that follow once it rests
_CAMERA_STEP = 3  # every third camera is drawn


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Shows a scene bundle, or a task in it, in the browser."""

  bundle: Annotated[Path | None, tyro.conf.Positional] = None
  """Folder of the scene bundle; the built-in room if not given."""
  task: str | None = None
  """Shows a task of the suite in the scene, such as nerf_nav, instead of the scene alone."""
  host: str = "127.0.0.1"
  """Address to serve on; 0.0.0.0 lets other machines connect."""
  port: int = 8080
  """Port to serve on."""


class FieldView:
  """Draws the radiance field behind the scene from wherever a client looks."""

  def __init__(self, bundle: Bundle):
    self._renderer = Renderer(Field.load(bundle.field_path), threads=os.cpu_count() or 1)
    self._unit_from_world = bundle.world_from_unit.inverse()
    self._scale = bundle.world_from_unit.scale
    self._lock = threading.Lock()  # one picture at a time: the kernel takes a whole core

  def render(self, camera: viser.CameraHandle, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns colour [H, W, 3] (uint8) and depth [H, W] [m] as a client's camera sees them."""
    height = max(1, round(width / camera.aspect))
    pose = np.eye(4)
    pose[:3, :3] = transforms.SO3(camera.wxyz).as_matrix()
    pose[:3, 3] = camera.position
    lens = Camera.from_vertical_fov(camera.fov, width, height)
    with self._lock:
      color, depth = self._renderer.render(lens, self._unit_from_world.apply_pose(pose))
    return color, depth * self._scale


class ClientLoop:
  """Keeps one client's background up to date: coarse while moving, then finer and finer."""

  def __init__(self, client: viser.ClientHandle, view: FieldView, enabled: viser.GuiCheckboxHandle):
    self._client, self._view, self._enabled = client, view, enabled
    self._changed = threading.Event()
    self._changed.set()
    self.closed = False
    client.camera.on_update(lambda _: self._changed.set())
    threading.Thread(target=self._run, daemon=True).start()

  def refresh(self) -> None:
    """Draws anew, as after a switch was turned."""
    self._changed.set()

  def _run(self) -> None:
    while not self.closed:
      self._changed.wait(timeout=1.0)
      if not self._changed.is_set():
        continue
      self._changed.clear()
      if not self._enabled.value:
        self._client.scene.set_background_image(None)
        continue
      for width in (_MOVING_WIDTH, *_STILL_WIDTHS):
        color, depth = self._view.render(self._client.camera, width)
        self._client.scene.set_background_image(
          color, depth=np.where(np.isfinite(depth), depth, 1e3)[..., None], jpeg_quality=90
        )
        if self._changed.wait(timeout=0.05):
          break


def _add_scene(server: viser.ViserServer, bundle: Bundle) -> None:
  """Adds meshes, parts, cameras and the free-space map, each with a switch."""
  visual = trimesh.load_mesh(bundle.visual_path)
  shown = server.scene.add_mesh_trimesh("/visual", visual)
  shown.visible = False
  parts = []
  for index, path in enumerate(bundle.collision_parts):
    part = trimesh.load_mesh(path)
    red, green, blue = (int(part_color(index)[k : k + 2], 16) for k in (1, 3, 5))
    parts.append(
      server.scene.add_mesh_simple(
        f"/parts/{index:03d}",
        part.vertices,
        part.faces,
        color=(red, green, blue),
        opacity=0.85,
        flat_shading=True,
      )
    )
    parts[-1].visible = False
  frusta = []
  sfm = localise.load(bundle.folder / "sfm")
  fov = 2 * np.arctan(0.5 * sfm.camera.height / sfm.camera.fy)
  for name, pose in list(zip(sfm.names, sfm.world_from_camera, strict=True))[::_CAMERA_STEP]:
    world = bundle.world_from_unit.apply_pose(pose)
    frusta.append(
      server.scene.add_camera_frustum(
        f"/cameras/{name}", fov=float(fov), aspect=sfm.camera.width / sfm.camera.height, scale=0.08,
        wxyz=transforms.SO3.from_matrix(world[:3, :3]).wxyz, position=world[:3, 3],
        color=(213, 94, 0), thickness=0.004,
      )
    )  # fmt: skip
  grid = server.scene.add_grid("/floor", width=8.0, height=8.0, cell_size=0.5)

  for label, handles, on in (
    ("surface mesh", [shown], False),
    ("convex parts", parts, False),
    ("cameras", frusta, True),
    ("floor grid", [grid], True),
  ):
    switch = server.gui.add_checkbox(label, on)

    @switch.on_update
    def _(event, switch=switch, handles=handles):
      for handle in handles:
        handle.visible = switch.value

  figures = [f"| {key} | {value:.4g} |" if isinstance(value, float) else f"| {key} | {value} |"
             for key, value in bundle.figures.items() if not isinstance(value, dict)]  # fmt: skip
  with server.gui.add_folder("figures", expand_by_default=False):
    server.gui.add_markdown("\n".join(["| figure | value |", "| --- | --- |", *figures]))


def view_bundle(bundle: Bundle, *, host: str, port: int) -> viser.ViserServer:
  """Serves a bundle's viewer; returns the running server."""
  server = viser.ViserServer(host=host, port=port, label=f"scene {bundle.name}", verbose=False)
  server.scene.set_up_direction("+z")
  lower, upper = bundle.extent
  centre = 0.5 * (lower + upper)
  server.initial_camera.position = (centre[0] - 0.35 * (upper - lower)[0], centre[1], 1.2)
  server.initial_camera.look_at = (centre[0], centre[1], 0.8)
  view = FieldView(bundle)
  enabled = server.gui.add_checkbox("radiance field", True)
  _add_scene(server, bundle)
  loops: dict[int, ClientLoop] = {}

  @server.on_client_connect
  def _(client: viser.ClientHandle) -> None:
    loops[client.client_id] = ClientLoop(client, view, enabled)

  @server.on_client_disconnect
  def _(client: viser.ClientHandle) -> None:
    loops.pop(client.client_id).closed = True

  @enabled.on_update
  def _(event) -> None:
    for loop in loops.values():
      loop.refresh()

  return server


def main() -> None:
  """Parses the command line and serves until interrupted."""
  arguments = tyro.cli(Arguments, description=__doc__)
  try:
    if arguments.task is not None:
      from view_task import view_task  # beside this script

      view_task(arguments.task, scene=arguments.bundle, host=arguments.host, port=arguments.port)
      return
    server = view_bundle(Bundle.load(arguments.bundle), host=arguments.host, port=arguments.port)
  except (ValueError, OSError) as error:
    sys.exit(f"error: {error}")
  print(f"open http://{arguments.host}:{server.get_port()} (Ctrl-C ends)")
  try:
    while True:
      time.sleep(1.0)
  except KeyboardInterrupt:
    server.stop()


if __name__ == "__main__":
  main()
