"""Paints drawn rooms: plain walls, as people have them, and materials of which many are plain."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.scenes.builtin import art, furniture, patterns, surfaces, textures
from nerf2real.scenes.builtin.solids import Solid

Array = np.ndarray
Random = np.random.Generator

POSTERS = 6
SHELL_PIXELS = 240  # texels per metre of floor and walls
_SMALL = (384, 384)
_PAINTS = ((236, 234, 228), (228, 222, 208), (205, 216, 220), (214, 222, 205), (232, 214, 204))
_WALLS = ("paint", "paint", "paint", "wallpaper", "plaster")  # three in five walls are plain
_FLOORS = ("planks", "carpet", "tiles")


def _paint(random: Random, shape: tuple[int, int], colour: Any) -> Array:
  """Returns rolled paint: a few grey levels of structure, float [H, W, 3]."""
  level = random.uniform(1.0, 4.0)
  fine, coarse = (textures.noise(random, shape, slope=s) for s in (0.6, 1.6))
  return np.asarray(colour, float) + level * (0.5 * fine + coarse)[..., None]


def _wall(random: Random, shape: tuple[int, int]) -> Array:
  colour = np.array(_PAINTS[random.integers(len(_PAINTS))], float)
  kind = random.choice(_WALLS)
  if kind == "paint":
    return _paint(random, shape, colour)
  if kind == "plaster":
    return textures.plaster(random, shape, dark=colour * 0.86, light=colour)
  picture = _paint(random, shape, colour)  # wallpaper with stripes, each as any other
  width = int(random.uniform(0.06, 0.16) * SHELL_PIXELS)
  stripes = (np.arange(shape[1]) // width % 2).astype(bool)
  picture[:, stripes] *= random.uniform(0.82, 0.93)
  return picture


def _tiles(random: Random, shape: tuple[int, int]) -> Array:
  """Returns square tiles with joints, float [H, W, 3]."""
  size = int(random.uniform(0.25, 0.5) * SHELL_PIXELS)
  rows, columns = (n // size + 1 for n in shape)
  shade = random.normal(0.0, 4.0, (rows, columns)).repeat(size, 0).repeat(size, 1)
  picture = textures.plaster(random, shape, dark=(150, 146, 138), light=(186, 180, 170))
  picture = picture + shade[: shape[0], : shape[1], None]
  for axis in (0, 1):
    joint = np.arange(shape[axis]) % size < 3
    picture[(slice(None), joint) if axis else joint] = (112, 108, 102)
  return picture


def _cloth(random: Random, shape: tuple[int, int]) -> Array:
  """Returns cloth, of which half has a print and half a weave alone, float [H, W, 3]."""
  base = np.clip(random.uniform(55.0, 195.0) + random.normal(0.0, 22.0, 3), 20.0, 225.0)
  if random.uniform() < 0.5:
    return textures.fabric(random, shape, dark=base * 0.85, light=np.minimum(base * 1.15, 255))
  weave = textures.noise(random, shape, slope=0.3) + textures.noise(random, shape, slope=1.4)
  return base + random.uniform(2.0, 5.0) * weave[..., None]


def _floor(random: Random, shape: tuple[int, int]) -> Array:
  kind = random.choice(_FLOORS)
  if kind == "tiles":
    return _tiles(random, shape)
  if kind == "carpet":
    return _cloth(random, shape)
  dark = random.uniform((70, 48, 30), (150, 116, 80))
  return textures.planks(random, shape, rows=int(shape[0] / 34), dark=dark, light=dark * 1.5)


def paint(things: Sequence[Solid], random: Random) -> dict[str, Array]:
  """Returns the textures of a room's solids by name, uint8 [H, W, 3].

  Args:
    things: All solids; what is named `shell` and fits one face gets a picture of its own, with the
      light that gathers in corners.
    random: Source of randomness.
  """
  plain: dict[str, Any] = {
    "white": (238, 237, 233),
    "black": (26, 26, 28),
    "metal": (150, 152, 155),
    "lacquer": random.uniform((60, 60, 60), (220, 210, 200)),
  }
  named = {name: _paint(random, _SMALL, colour) for name, colour in plain.items()}
  for name, low in (("wood", (120, 84, 50)), ("dark", (58, 40, 28))):
    base = np.array(low) * random.uniform(0.8, 1.3)
    named[name] = textures.wood(random, _SMALL, dark=base, light=base * 1.45)
  for name in ("cloth", "cover", "curtain"):
    named[name] = _cloth(random, _SMALL)
  named["leaf"] = textures.leaf(random, (128, 256))
  named["card"] = patterns.cardboard(random, _SMALL)
  named["rug"] = patterns.rug(random, (480, 720))
  named["window"] = art.window_view(random, (480, 620))
  named["door"] = art.door(random, (900, 380))
  for k in range(POSTERS):
    shape = (int(random.integers(360, 640)), int(random.integers(360, 560)))
    named[f"poster_{k}"] = art.poster(random, shape, style=int(random.integers(4)))
  cells = furniture.MARKER_MARGIN_CELLS
  named["marker"] = patterns.marker(furniture.MARKER_ID, cell=40, margin_cells=cells)
  thick = [s for s in things if not s.name.startswith(("hung", "marker"))]
  for solid in thick:
    if solid.name.startswith("shell") and solid.tiles is None:
      width, height = (int(2 * s * SHELL_PIXELS) for s in solid.size[:2])
      shape = (height, width)
      make = _floor if solid.material == "floor" else _wall
      picture = _paint(random, shape, _PAINTS[0]) if solid.material == "ceiling" else None
      picture = make(random, shape) if picture is None else picture
      named[solid.material] = picture * surfaces.occlusion(solid, thick, shape)[..., None]
  return {name: textures.to_uint8(picture) for name, picture in named.items()}
