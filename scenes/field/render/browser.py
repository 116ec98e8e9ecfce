"""The radiance field behind a scene in the browser, drawn from wherever a client looks."""

import threading
from collections.abc import Callable

import numpy as np
import viser
from viser import transforms

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.field.render.renderer import Renderer

_MOVING_WIDTH = 160  # pixels of a picture while the view moves
_STILL_WIDTHS = (320, 640, 960)  # pixels of the pictures that follow once it rests


def begin_as(server: viser.ViserServer, camera: Camera, world_from_camera: np.ndarray) -> None:
  """Lets clients begin as a camera of the capture saw the scene: pose [4, 4], height of its view.

  Beyond what the cameras saw the field is fog, and viser's own view is 75 degrees high.
  """
  start = server.initial_camera
  start.fov = camera.vertical_fov
  start.position = tuple(world_from_camera[:3, 3])
  start.look_at = tuple(world_from_camera[:3, 3] + world_from_camera[:3, 2])


class FieldView:
  """Renders the field for a client's camera."""

  def __init__(self, renderer: Renderer, world_from_unit: Similarity):
    """Connects a renderer in the unit frame with the world."""
    self._renderer = renderer
    self._unit_from_world = world_from_unit.inverse()
    self._scale = world_from_unit.scale
    self._lock = threading.Lock()  # one picture at a time: the kernel takes a whole core
    self._listeners: list[Callable[[], None]] = []

  def on_replaced(self, listener: Callable[[], None]) -> None:
    """Registers what is called when the field is replaced."""
    self._listeners.append(listener)

  def replace(self, renderer: Renderer) -> None:
    """Goes on with another field, such as one that has been trained further."""
    with self._lock:
      self._renderer = renderer
    for listener in self._listeners:
      listener()

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

  def __init__(
    self,
    client: viser.ClientHandle,
    view: FieldView,
    enabled: viser.GuiCheckboxHandle,
    *,
    setback: float = 0.0,
  ):
    """Starts to draw.

    Args:
      client: The client.
      view: Renders the field.
      enabled: The switch of the field.
      setback: Distance [m] by which the field's depth is set back, so that it does not swallow
        what stands on its surfaces.
    """
    self._client, self._view, self._enabled = client, view, enabled
    self._setback = setback
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
        depth = np.where(np.isfinite(depth), depth + self._setback, 1e3)
        self._client.scene.set_background_image(color, depth=depth[..., None], jpeg_quality=90)
        if self._changed.wait(timeout=0.05):
          break


def serve_field(
  server: viser.ViserServer, view: FieldView, *, setback: float = 0.0, shown: bool = True
) -> viser.GuiCheckboxHandle:
  """Draws the field for every client, with a switch on the page, `shown` at first; returns it."""
  enabled = server.gui.add_checkbox("radiance field", shown)
  loops: dict[int, ClientLoop] = {}

  @server.on_client_connect  # those that are connected already included
  def _(client: viser.ClientHandle) -> None:
    loops[client.client_id] = ClientLoop(client, view, enabled, setback=setback)

  @server.on_client_disconnect
  def _(client: viser.ClientHandle) -> None:
    loops.pop(client.client_id).closed = True

  def refresh() -> None:
    for loop in list(loops.values()):
      loop.refresh()

  enabled.on_update(lambda _: refresh())
  view.on_replaced(refresh)
  return enabled
