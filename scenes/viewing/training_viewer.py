"""A scene in the browser while it is made: keyframes, localised points, the field as it grows.

Everything is shown in the unit frame, in which +z is up; metres are known only at the end.
"""

import threading

import cv2
import numpy as np

from nerf2real.core import browser_view, palette
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.field.render.browser import FieldView, begin_as, serve_field
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.field.training import Snapshot
from nerf2real.scenes.poses.localisation import Localisation

_POINT_SIZE = 0.004  # [unit], 1 cm in a room of 5 m
_SHEET = (5, 3)  # rows and columns of the keyframes that are shown
_SHEET_WIDTH = 160  # of each of them [pixel]


def sheet(capture: Capture) -> np.ndarray:
  """Draws evenly chosen keyframes in rows: RGB uint8 [H, W, 3]; missing ones are white."""
  rows, columns = _SHEET
  height = round(_SHEET_WIDTH * capture.height / capture.width)
  drawn = np.full((rows * columns, height, _SHEET_WIDTH, 3), 255, np.uint8)
  count = len(capture.images)
  chosen = np.unique(np.linspace(0, count - 1, min(count, rows * columns)).astype(int))
  for place, index in enumerate(chosen):
    picture = cv2.imread(str(capture.images[index]))
    if picture is not None:
      small = cv2.resize(picture, (_SHEET_WIDTH, height), interpolation=cv2.INTER_AREA)
      drawn[place] = small[..., ::-1]
  in_rows = drawn.reshape(rows, columns, height, _SHEET_WIDTH, 3).swapaxes(1, 2)
  return in_rows.reshape(rows * height, columns * _SHEET_WIDTH, 3)


class TrainingViewer:
  """A page of a scene that is being made; a `scenes.stages.results.Watcher`."""

  def __init__(self, *, host: str, port: int):
    """Serves the page; see `address`."""
    self._server = browser_view.serve("a scene is made", host=host, port=port)
    self._server.scene.set_up_direction("+z")
    self._text = self._server.gui.add_markdown("Keyframes come first.")
    self._view: FieldView | None = None
    self._newest: Snapshot | None = None
    self._condition = threading.Condition()
    self._closed = False
    self._server.on_client_connect(lambda _: self._wake())
    self._thread = threading.Thread(target=self._draw, daemon=True)
    self._thread.start()

  @property
  def address(self) -> str:
    """Where a browser finds the page."""
    return f"http://{self._server.get_host()}:{self.port}"

  @property
  def port(self) -> int:
    """The page's port: a later one than was asked for where that was taken."""
    return self._server.get_port()

  @property
  def text(self) -> str:
    """What the page says, in Markdown."""
    return self._text.content

  def keyframes(self, capture: Capture) -> None:
    """Shows some of the keyframes beside the scene."""
    self._server.gui.add_image(sheet(capture), label="keyframes", format="jpeg")
    self._text.content = f"{len(capture.images)} keyframes. Their poses come next."

  def poses(self, found: Localisation) -> None:
    """Shows the localised points and keyframes."""
    self._server.scene.add_point_cloud(
      "/points",
      found.points.astype(np.float32),
      found.point_colors,
      point_size=_POINT_SIZE,
      point_shape="circle",
    )
    places = found.world_from_camera[:, :3, 3].astype(np.float32)
    self._server.scene.add_point_cloud(
      "/cameras", places, palette.rgb(palette.VERMILION), point_size=_POINT_SIZE
    )
    begin_as(self._server, found.camera, found.world_from_camera[found.overlooking()])
    count, keyframes = len(found.points), len(found.names)
    self._text.content = f"{keyframes} keyframes and {count:,} points. The field comes next."

  def field(self, snapshot: Snapshot) -> None:
    """Hands a snapshot to the page's own thread; an older one that waits is dropped."""
    minutes, seconds = divmod(round(snapshot.seconds_left), 60)
    self._text.content = (
      f"Step {snapshot.step:,}: **{snapshot.psnr_db:.1f} dB** on training rays "
      f"(blurred ones among them), {minutes}:{seconds:02d} min left."
    )
    with self._condition:
      self._newest = snapshot
      self._condition.notify()

  def close(self) -> None:
    """Takes the page down."""
    with self._condition:
      self._closed = True
      self._condition.notify()
    self._thread.join()
    self._server.stop()

  def _due(self) -> bool:
    """Whether a field waits to be shown; what nobody looks at costs the training no time."""
    return self._newest is not None and bool(self._server.get_clients())

  def _wake(self) -> None:
    with self._condition:
      self._condition.notify()

  def _draw(self) -> None:
    while True:
      with self._condition:
        self._condition.wait_for(lambda: self._due() or self._closed)
        if self._closed:
          return
        snapshot, self._newest = self._newest, None
      assert snapshot is not None
      self._show(snapshot)

  def _show(self, snapshot: Snapshot) -> None:
    renderer = Renderer(snapshot.field)
    if self._view is None:
      self._view = FieldView(renderer, Similarity())
      serve_field(self._server, self._view)
      for name in ("/points", "/cameras"):
        self._server.scene.remove_by_name(name)
    else:
      self._view.replace(renderer)
