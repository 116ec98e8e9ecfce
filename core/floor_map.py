"""Top-down floor map: occupancy grid, paths, goals, robot poses and heat maps drawn as a picture.

World x runs to the right and y upwards, both in metres. Shapes: H height, W width, N points.
"""

import dataclasses
from typing import Self

import cv2
import numpy as np

from nerf2real.core import palette
from nerf2real.core.palette import Rgb

# Pale, so that everything drawn on it stands out.
REACHABLE, FREE, UNKNOWN, OCCUPIED = (
  (250, 248, 244),
  (208, 211, 215),
  (163, 168, 176),
  (96, 102, 112),
)
_FINE = 4  # OpenCV draws at fractions of a pixel: 4 bits
_MARKER_SIZE = 0.025  # half a marker's width, of the picture's longer side
_DIMMED = 0.6  # of a floor's brightness below a heat map
_ROBOT_RADIUS, _NOSE = 0.13, 0.28  # m: the OP3's trunk, and a line that shows its heading

Extent = tuple[float, float, float, float]  # x from, x to, y from, y to [m]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Floor:
  """An occupancy grid; row 0 is the smallest y, column 0 the smallest x."""

  reachable: np.ndarray
  """Cells where the robot's centre can be, bool [H, W]."""
  resolution: float
  """Edge of a cell [m]."""
  origin: np.ndarray
  """World x, y of the grid's lower left corner [2] [m]."""
  occupied: np.ndarray | None = None
  """Cells with matter, bool [H, W]; None where only the reachable cells are known."""
  unknown: np.ndarray | None = None
  """Cells that were never seen, bool [H, W]."""

  @property
  def extent(self) -> Extent:
    """The area of all cells."""
    height, width = self.reachable.shape
    x, y = (float(corner) for corner in self.origin)
    return x, x + width * self.resolution, y, y + height * self.resolution

  def colors(self) -> np.ndarray:
    """Returns the colour of each cell, RGB uint8 [H, W, 3]."""
    found = np.where(self.reachable[..., None], REACHABLE, FREE).astype(np.uint8)
    for cells, color in ((self.unknown, UNKNOWN), (self.occupied, OCCUPIED)):
      if cells is not None:
        found[cells] = color
    return found


class FloorMap:
  """A picture of a floor from above, in which places are drawn by their metres.

  `picture` is RGB uint8 [H, W, 3]; its first row is the largest y. The drawing methods return the
  map, so that calls can be chained.
  """

  def __init__(self, extent: Extent, picture: np.ndarray):
    """Draws on a picture [H, W, 3] of the extent; the picture is changed."""
    self.extent, self.picture = extent, picture
    self._scale = picture.shape[0] / (extent[3] - extent[2])  # pixel/m
    self._marker = max(3, round(_MARKER_SIZE * max(picture.shape[:2])))  # pixel

  @classmethod
  def of(cls, floor: Floor, *, height: int, extent: Extent | None = None) -> Self:
    """Draws an occupancy grid.

    Args:
      floor: The grid.
      height: Height of the picture [pixel]; the width follows from the extent.
      extent: The area to draw; what lies outside the grid counts as unreachable. The whole grid if
        not given.
    """
    extent = floor.extent if extent is None else extent
    x_from, x_to, y_from, y_to = extent
    scale = height / (y_to - y_from)
    width = max(1, round((x_to - x_from) * scale))
    x = x_from + (np.arange(width) + 0.5) * (x_to - x_from) / width
    y = y_to - (np.arange(height) + 0.5) / scale
    columns = np.floor((x - floor.origin[0]) / floor.resolution).astype(int)
    rows = np.floor((y - floor.origin[1]) / floor.resolution).astype(int)
    colors = floor.colors()
    inside_y = (rows >= 0) & (rows < colors.shape[0])
    inside_x = (columns >= 0) & (columns < colors.shape[1])
    picture = np.full((height, width, 3), FREE, np.uint8)
    picture[np.ix_(inside_y, inside_x)] = colors[np.ix_(rows[inside_y], columns[inside_x])]
    return cls(extent, picture)

  def copy(self) -> "FloorMap":
    """Returns a map with a picture of its own."""
    return FloorMap(self.extent, self.picture.copy())

  def path(self, xy: np.ndarray, color: Rgb, *, width: int = 2) -> Self:
    """Draws a line through places [N, >= 2]."""
    points = self._fine(xy)
    cv2.polylines(self.picture, [points], False, color, width, cv2.LINE_AA, _FINE)
    return self

  def disc(self, xy: np.ndarray, radius: float, color: Rgb) -> Self:
    """Fills a circle of a radius [m] about a place [2]."""
    return self.circle(xy, radius, color, width=-1)

  def circle(self, xy: np.ndarray, radius: float, color: Rgb, *, width: int = 2) -> Self:
    """Draws a circle of a radius [m] about a place [2]."""
    x, y = self._fine(np.asarray(xy)[None])[0].tolist()
    size = round(radius * self._scale * 2**_FINE)
    cv2.circle(self.picture, (x, y), size, color, width, cv2.LINE_AA, _FINE)
    return self

  def box(self, lower: np.ndarray, upper: np.ndarray, color: Rgb) -> Self:
    """Draws the outline of a rectangle between two corners [2]."""
    (left, bottom), (right, top) = np.asarray(lower)[:2], np.asarray(upper)[:2]
    corners = [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
    return self.path(np.array(corners), color)

  def cross(self, xy: np.ndarray, color: Rgb) -> Self:
    """Marks a place [2] with an X."""
    x, y = self._fine(np.asarray(xy)[None])[0]
    size, width = self._marker << _FINE, max(1, self._marker // 3)
    for sign in (-1, 1):
      ends = (int(x - size), int(y - sign * size)), (int(x + size), int(y + sign * size))
      cv2.line(self.picture, *ends, color, width, cv2.LINE_AA, _FINE)
    return self

  def triangle(self, xy: np.ndarray, color: Rgb) -> Self:
    """Marks a place [2] with a triangle."""
    corners = np.array([(0, -1), (-1, 1), (1, 1)]) * (self._marker << _FINE)
    points = self._fine(np.asarray(xy)[None]) + corners
    cv2.fillPoly(self.picture, [points.astype(np.int32)], color, cv2.LINE_AA, _FINE)
    return self

  def robot(self, xy: np.ndarray, yaw: float, color: Rgb = (0, 90, 150)) -> Self:
    """Draws a robot at a place [2] with its heading [rad]."""
    position = np.asarray(xy, np.float64)[:2]
    nose = position + _NOSE * np.array([np.cos(yaw), np.sin(yaw)])
    self.disc(position, _ROBOT_RADIUS, color)
    return self.path(np.stack([position, nose]), color, width=3)

  def label(self, xy: np.ndarray, words: str) -> Self:
    """Writes words in the middle of a place [2], on a pale ground."""
    font, size = cv2.FONT_HERSHEY_SIMPLEX, max(0.4, self.picture.shape[0] / 900)
    (width, height), below = cv2.getTextSize(words, font, size, 1)
    x, y = (self._fine(np.asarray(xy)[None])[0] >> _FINE).tolist()
    left, bottom = x - width // 2, y + height // 2
    corners = (left - 3, bottom - height - 3), (left + width + 3, bottom + below)
    cv2.rectangle(self.picture, *corners, REACHABLE, -1)
    ink = palette.rgb(palette.INK)
    cv2.putText(self.picture, words, (left, bottom), font, size, ink, 1, cv2.LINE_AA)
    return self

  def heat(self, density: np.ndarray) -> Self:
    """Lays a heat map [rows, columns] of the whole extent over the dimmed floor.

    Row 0 is the largest y. The brightest colour is the largest density.
    """
    height, width = self.picture.shape[:2]
    share = (density / max(float(density.max()), 1e-12)).astype(np.float32)
    level = np.asarray(cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR))
    color = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]
    opacity = np.clip(2 * level, 0, 1)[..., None]
    self.picture = (opacity * color + (1 - opacity) * _DIMMED * self.picture).astype(np.uint8)
    return self

  def scale_bar(self) -> Self:
    """Draws a bar of a metre with its name into the lower left corner, on a pale ground."""
    height, ink = self.picture.shape[0], palette.rgb(palette.INK)
    size, font = round(self._scale), max(0.4, height / 900)
    text_height = round(25 * font)
    cv2.rectangle(
      self.picture, (6, height - 22 - text_height), (size + 22, height - 6), REACHABLE, -1
    )
    cv2.line(self.picture, (14, height - 12), (14 + size, height - 12), ink, 2)
    cv2.putText(
      self.picture,
      "1 m",
      (14, height - 19),
      cv2.FONT_HERSHEY_SIMPLEX,
      font,
      ink,
      1,
      cv2.LINE_AA,
    )
    return self

  def _fine(self, xy: np.ndarray) -> np.ndarray:
    """Returns places [N, >= 2] as pixels in sixteenths, int32 [N, 2]."""
    places = np.asarray(xy, np.float64)
    x = (places[:, 0] - self.extent[0]) * self._scale
    y = (self.extent[3] - places[:, 1]) * self._scale
    return np.rint(np.stack([x, y], -1) * 2**_FINE).astype(np.int32)
