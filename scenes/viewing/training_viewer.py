"""A field in the browser while it is trained: localised points first, then the field as it grows.

Everything is shown in the unit frame, in which +z is up; metres are known only at the end.
"""

import threading

import numpy as np
import viser

from nerf2real.core import palette
from nerf2real.core.similarity import Similarity
from nerf2real.scenes.field.render.browser import FieldView, begin_as, serve_field
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.field.training import Snapshot
from nerf2real.scenes.poses.localisation import Localisation

_POINT_SIZE = 0.004  # [unit], 1 cm in a room of 5 m


class TrainingViewer:
  """A page of a scene that is being made; a `scenes.stages.results.Watcher`."""

  def __init__(self, *, host: str, port: int):
    """Serves the page; see `address`."""
    self._server = viser.ViserServer(host=host, port=port, label="a scene is made", verbose=False)
    self._server.scene.set_up_direction("+z")
    self._text = self._server.gui.add_markdown("Keyframes and their poses come first.")
    self._view: FieldView | None = None
    self._newest: Snapshot | None = None
    self._condition = threading.Condition()
    self._closed = False
    self._thread = threading.Thread(target=self._draw, daemon=True)
    self._thread.start()

  @property
  def address(self) -> str:
    """Where a browser finds the page."""
    return f"http://{self._server.get_host()}:{self._server.get_port()}"

  @property
  def text(self) -> str:
    """What the page says, in Markdown."""
    return self._text.content

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

  def _draw(self) -> None:
    while True:
      with self._condition:
        self._condition.wait_for(lambda: self._newest is not None or self._closed)
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
    minutes, seconds = divmod(round(snapshot.seconds_left), 60)
    self._text.content = (
      f"Step {snapshot.step:,}: **{snapshot.psnr_db:.1f} dB** on training rays "
      f"(blurred ones among them), {minutes}:{seconds:02d} min left."
    )
