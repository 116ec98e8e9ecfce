"""The viewer's panel that writes an override file from points clicked in the scene."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import viser

from nerf2real.core import palette
from nerf2real.scenes.alignment import picking
from nerf2real.scenes.bundle import Bundle

_PIXEL_ANGLE = 2e-3  # rad that a click stands for: a pixel of a browser's window, about
_MARKER = 0.02  # m, radius of a marker
_COLORS = {
  picking.FLOOR: palette.GREEN,
  picking.DISTANCE: palette.BLUE,
  picking.ORIGIN: palette.VERMILION,
  picking.EXTENT: palette.INK,
}


class RayRenderer(Protocol):
  """What finds the surface behind a click: a renderer of the field."""

  def render_rays(
    self, origins: np.ndarray, directions: np.ndarray, pixel_angle: float
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns colour, distance (inf: none) and opacity of rays in the unit frame."""


def surface_point(
  renderer: RayRenderer, bundle: Bundle, origin: np.ndarray, direction: np.ndarray
) -> np.ndarray | None:
  """Returns where a ray of the world frame meets the field [3] [m]; None where nothing is met."""
  transform = bundle.world_from_unit
  start = transform.inverse().apply(np.asarray(origin, np.float64))
  way = transform.rotation.T @ np.asarray(direction, np.float64)
  way /= np.linalg.norm(way)
  _, distance, _ = renderer.render_rays(start[None], way[None], _PIXEL_ANGLE)
  if not np.isfinite(distance[0]):
    return None
  return np.asarray(transform.apply(start + float(distance[0]) * way))


class OverridePanel:
  """Collects clicked points, shows them in the frame of the override file, and saves them."""

  def __init__(self, server: viser.ViserServer, bundle: Bundle, renderer: RayRenderer):
    """Adds the panel to the page, folded.

    Args:
      server: The page's server.
      bundle: The scene.
      renderer: Of the bundle's field.
    """
    self._server, self._bundle, self._renderer = server, bundle, renderer
    lower, upper = bundle.extent
    self.picked = picking.Picked(bundle.world_from_unit, (float(lower[2]), float(upper[2])))
    self._markers: dict[str, list[Any]] = {purpose: [] for purpose in picking.PURPOSES}
    gui = server.gui
    with gui.add_folder("override file", expand_by_default=False):
      self._taking = gui.add_checkbox("clicks pick points", False)
      self.purpose = gui.add_dropdown("points for", tuple(picking.PURPOSES))
      self._hint = gui.add_markdown("")
      self.distance = gui.add_number("distance [m]", 1.0, min=0.001, step=0.001)
      gui.add_button("remove the last point").on_click(lambda _: self.remove_last())
      self.path = gui.add_text("file", f"{bundle.name}_override.yaml")
      gui.add_button("save").on_click(lambda _: self.save())
      self.status = gui.add_markdown("")
    self.purpose.on_update(lambda _: self._show())
    self.distance.on_update(lambda _: self._show())
    server.scene.on_click()(self._click)
    self._show()

  def _click(self, event: Any) -> None:
    if not self._taking.value:
      return
    ray = np.array(event.ray_origin), np.array(event.ray_direction)
    point = surface_point(self._renderer, self._bundle, *ray)
    if point is None:
      self.status.content = "Nothing of the room is there: click on a surface."
    else:
      self.add(point)

  def add(self, point: np.ndarray) -> None:
    """Takes a point of the world frame [3] [m] for the chosen purpose."""
    purpose = self.purpose.value
    points, markers = self.picked.points[purpose], self._markers[purpose]
    points.append(point)
    marker = self._server.scene.add_icosphere(
      f"/picked/{purpose}/{len(points)}",
      radius=_MARKER,
      color=palette.rgb(_COLORS[purpose]),
      position=tuple(point),
    )
    markers.append(marker)
    self._show()

  def remove_last(self) -> None:
    """Removes the last point of the chosen purpose."""
    purpose = self.purpose.value
    if self.picked.points[purpose]:
      self.picked.points[purpose].pop()
      self._markers[purpose].pop().remove()
    self._show()

  def save(self) -> None:
    """Writes the file, or shows why not."""
    path = Path(self.path.value)
    try:
      picking.save(path, self.picked.values(distance=self.distance.value))
    except (ValueError, OSError) as error:
      self.status.content = f"**not saved**: {error}"
    else:
      self.status.content = (
        f"saved {path.resolve()}; make the scene again with the same `--out` and "
        f"`--override {path}`"
      )

  def _show(self) -> None:
    """Shows what the file would hold now, or what is missing."""
    self._hint.content = picking.PURPOSES[self.purpose.value]
    try:
      values = self.picked.values(distance=self.distance.value)
    except ValueError as error:
      self.status.content = str(error)
    else:
      self.status.content = "\n".join(f"- {name}: {value}" for name, value in values.items())
