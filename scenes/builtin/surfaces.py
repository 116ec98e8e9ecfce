"""The looks of the built-in room: every texture by name, with light that gathers in corners."""

from collections.abc import Sequence

import cv2
import numpy as np

from nerf2real.scenes.builtin import art, furniture, patterns, solids, textures
from nerf2real.scenes.builtin.placing import ROOM_SIZE

_PLANK_ROWS = 26
_AO_HEIGHTS = (0.04, 0.10, 0.25, 0.5)  # where occlusion is probed above a surface [m]
_AO_WEIGHTS = (0.16, 0.20, 0.24, 0.22)  # how dark each makes a corner; chosen by eye
_AO_STEP = 0.04  # grid of the probes [m]
_SHELL_PIXELS = 320  # texels per metre of floor and walls
_POSTERS = (  # heights and widths [pixel]
  (560, 440),
  (380, 520),
  (480, 360),
  (640, 460),
  (520, 400),
  (640, 460),
  (560, 460),
  (390, 520),
)


def occlusion(
  solid: solids.Solid, things: list[solids.Solid], shape: tuple[int, int]
) -> np.ndarray:
  """Brightness [H, W] of the +z face of a panel: dark in corners and beside furniture."""
  half_x, half_y, half_z = solid.size
  columns, rows = (max(round(2 * s / _AO_STEP), 2) for s in (half_x, half_y))
  x = (np.arange(columns) + 0.5) / columns * 2 * half_x - half_x
  y = half_y - (np.arange(rows) + 0.5) / rows * 2 * half_y
  grid = np.stack([*np.meshgrid(x, y), np.full((rows, columns), half_z)], -1).reshape(-1, 3)
  points = grid @ solid.rotation.T + solid.position
  light = np.ones(len(points))
  for height, weight in zip(_AO_HEIGHTS, _AO_WEIGHTS, strict=True):
    gap = solids.distance(things, points + height * solid.rotation[:, 2], limit=height)
    light *= 1 - weight * np.clip(1 - gap / height, 0, 1)
  picture = light.reshape(rows, columns).astype(np.float32)
  smooth = cv2.GaussianBlur(picture, (0, 0), 1.0)
  return cv2.resize(smooth, shape[::-1], interpolation=cv2.INTER_CUBIC)


def _floor(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  picture = textures.planks(rng, shape, rows=_PLANK_ROWS, dark=(112, 78, 48), light=(196, 152, 106))
  height, width = shape
  rug = patterns.rug(rng, (int(1.7 * _SHELL_PIXELS), int(2.4 * _SHELL_PIXELS)))
  left, top = int((2.5 - 0.75) / 5 * width), int((2 - 0.72) / 4 * height)
  picture[top : top + rug.shape[0], left : left + rug.shape[1]] = rug
  return picture


def _terrazzo(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  ground = textures.plaster(rng, shape, dark=(150, 168, 172), light=(206, 216, 212))
  colours = [(104, 128, 138), (226, 226, 214), (188, 150, 118), (78, 98, 112), (206, 178, 150)]
  return textures.scattered(rng, ground, count=3600, sizes=(3, 14), colours=colours)


def _stencilled(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  ground = textures.plaster(rng, shape, dark=(190, 158, 110), light=(236, 214, 172))
  colours = [(168, 122, 76), (240, 224, 190), (148, 132, 92), (196, 140, 96)]
  return textures.scattered(rng, ground, count=2600, sizes=(3, 16), colours=colours)


def paint(things: Sequence[solids.Solid], rng: np.random.Generator) -> dict[str, np.ndarray]:
  """Returns every texture by name, uint8 [H, W, 3].

  Args:
    things: The room's solids: they darken the floor and the walls beside them.
    rng: Source of randomness.
  """
  x, y, z = (int(s * _SHELL_PIXELS) for s in ROOM_SIZE)
  small = (512, 512)
  named = {
    "floor": _floor(rng, (y, x)),
    "ceiling": textures.plaster(rng, (y, x), dark=(206, 203, 196), light=(240, 238, 232)),
    "wall_north": _terrazzo(rng, (z, x)),
    "wall_south": patterns.botanical(rng, (z, x), stems=420),
    "wall_east": _stencilled(rng, (z, y)),
    "wall_west": textures.bricks(rng, (z, y), rows=34, columns=18),
    "botanical": patterns.botanical(rng, small, stems=60),
    "rug": patterns.rug(rng, small),
    "pale_wood": textures.wood(rng, small, dark=(150, 114, 76), light=(216, 184, 140)),
    "dark_wood": textures.wood(rng, small, dark=(62, 42, 30), light=(124, 88, 62)),
    "red_wood": textures.wood(rng, small, dark=(104, 52, 32), light=(176, 104, 66)),
    "cloth_blue": textures.fabric(rng, small, dark=(48, 74, 96), light=(118, 146, 162)),
    "cloth_ochre": textures.fabric(rng, small, dark=(160, 112, 44), light=(224, 184, 104)),
    "slate": textures.plaster(rng, small, dark=(36, 38, 42), light=(92, 94, 98)),
    "glaze": textures.plaster(rng, small, dark=(120, 132, 138), light=(226, 226, 218)),
    "plaster": textures.plaster(rng, small, dark=(180, 178, 172), light=(236, 234, 228)),
    "soil": textures.plaster(rng, (128, 128), dark=(34, 24, 16), light=(96, 72, 50)),
    "leaf": textures.leaf(rng, (128, 256)),
    "cardboard": patterns.cardboard(rng, small),
    "spines": art.spines(rng, (320, 64 * art.SPINES)),
    "window": art.window_view(rng, (480, 620)),
    "door": art.door(rng, (900, 380)),
    "marker": patterns.marker(
      furniture.MARKER_ID, cell=40, margin_cells=furniture.MARKER_MARGIN_CELLS
    ),
  }
  for k, shape in enumerate(_POSTERS):
    named[f"poster_{k}"] = art.poster(rng, shape, style=k % 4)
  thick = [s for s in things if not s.name.startswith(("picture", "marker"))]
  for solid in thick:
    if solid.name.startswith("shell") and solid.tiles is None:
      picture = named[solid.material]
      named[solid.material] = picture * occlusion(solid, thick, picture.shape[:2])[..., None]
  return {name: textures.to_uint8(picture) for name, picture in named.items()}
