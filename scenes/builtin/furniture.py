"""Furniture of the built-in room, as lists of solids. World frame: z up, floor z = 0, metres.

The room spans x in [-2.5, 2.5], y in [-2, 2], z in [0, 2.5]. Furniture stands along the walls; the
rectangle FREE_AREA of the floor stays empty for a robot and a ball.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.rotations import yaw_matrix as yaw
from nerf2real.scenes.builtin import art
from nerf2real.scenes.builtin.placing import ROOM_SIZE, Group, facing
from nerf2real.scenes.builtin.potted_plant import plant
from nerf2real.scenes.builtin.solids import Solid

FREE_AREA = ((-1.2, -1.68), (1.85, 1.33))  # two corners (x, y), 3.05 x 3.01 m
MARKER_ID = 0
MARKER_SIZE = 0.20  # edge of the black square [m]
MARKER_MARGIN_CELLS = 1.2  # white margin [cell]
MARKER_CENTRE = (0.45, -0.08)  # on the floor [m]
MARKER_YAW = 0.35  # [rad]
_PAPER_THICKNESS = 0.0015


def shell() -> list[Solid]:
  """Returns floor, ceiling, walls and skirting boards; textures of the first six fit one face."""
  x, y, z = (0.5 * s for s in ROOM_SIZE)
  group, thick = Group("shell"), 0.05
  down = Rotation.from_euler("x", np.pi).as_matrix()
  panels = [
    ("floor", (x, y), (0, 0, -thick), np.eye(3)),
    ("ceiling", (x, y), (0, 0, 2 * z + thick), down),
    ("wall_north", (x, z), (0, y + thick, z), facing((0, -1, 0))),
    ("wall_south", (x, z), (0, -y - thick, z), facing((0, 1, 0))),
    ("wall_east", (y, z), (x + thick, 0, z), facing((-1, 0, 0))),
    ("wall_west", (y, z), (-x - thick, 0, z), facing((1, 0, 0))),
  ]
  for material, half, place, rotation in panels:
    group.add("box", (*half, thick), place, material, rotation=rotation, tiles=None)
  board: dict[str, Any] = {"material": "pale_wood", "tiles": 0.5, "rounding": 0.004}
  for sign in (-1, 1):
    group.add("box", (x, 0.008, 0.045), (0, sign * (y - 0.008), 0.045), **board)
    if sign < 0:
      group.add("box", (0.008, y, 0.045), (sign * (x - 0.008), 0, 0.045), **board)
    else:  # the east wall has a door
      group.add("box", (0.008, 1.41, 0.045), (x - 0.008, 0.59, 0.045), **board)
  return group.solids


def marker_sheet() -> list[Solid]:
  """Returns the printed ArUco marker that lies on the floor."""
  half = MARKER_SIZE * (0.5 + MARKER_MARGIN_CELLS / 6)
  group = Group("marker", (*MARKER_CENTRE, 0), MARKER_YAW)
  thickness = 0.5 * _PAPER_THICKNESS
  group.add("box", (half, half, thickness), (0, 0, thickness), "marker", tiles=None)
  return group.solids


def marker_corners() -> np.ndarray:
  """Returns the corners of the marker's black square in the world [4, 3], in OpenCV's order."""
  half = 0.5 * MARKER_SIZE
  local = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
  return local @ yaw(MARKER_YAW).T + [*MARKER_CENTRE, _PAPER_THICKNESS]


def sofa() -> list[Solid]:
  """Returns a sofa on the north wall with cushions."""
  group = Group("sofa", (0.15, 1.69, 0))
  cloth: dict[str, Any] = {"material": "cloth_blue", "tiles": 0.9}
  group.add("box", (0.95, 0.29, 0.13), (0, 0, 0.20), rounding=0.03, **cloth)
  group.add("box", (0.95, 0.09, 0.24), (0, 0.205, 0.52), rounding=0.06, **cloth)
  for side in (-1, 1):
    group.add("box", (0.10, 0.29, 0.20), (side * 0.86, 0, 0.38), rounding=0.06, **cloth)
    group.add("box", (0.37, 0.235, 0.075), (side * 0.375, -0.06, 0.385), rounding=0.05, **cloth)
    for y in (-0.22, 0.22):
      group.add("cone", (0.018, 0.026, 0.04), (side * 0.85, y, 0.04), "dark_wood", tiles=1.5)
  for x, tilt, turn, material in (
    (-0.6, 0.5, 0.25, "rug"),
    (-0.2, 0.42, -0.1, "cloth_ochre"),
    (0.56, 0.5, -0.3, "botanical"),
  ):
    rotation = yaw(turn) @ Rotation.from_euler("x", np.pi / 2 - tilt).as_matrix()
    size, place = (0.19, 0.17, 0.065), (x, -0.0, 0.60)
    group.add("box", size, place, material, rotation=rotation, rounding=0.06, tiles=1.4)
  return group.solids


def table() -> list[Solid]:
  """Returns a table at the west wall with things on it."""
  group = Group("table", (-2.08, 0.42, 0))
  group.add("box", (0.36, 0.6, 0.018), (0, 0, 0.722), "pale_wood", rounding=0.006, tiles=0.9)
  group.add("box", (0.31, 0.54, 0.04), (0, 0, 0.665), "pale_wood", tiles=0.7)
  for x in (-0.31, 0.31):
    for y in (-0.54, 0.54):
      group.add("box", (0.028, 0.028, 0.352), (x, y, 0.352), "pale_wood", rounding=0.005, tiles=0.7)
  top = 0.74
  group.add("cone", (0.07, 0.15, 0.04), (0.1, -0.38, top + 0.04), "glaze", tiles=2.0)
  for k, (x, y) in enumerate(((0.06, -0.4), (0.13, -0.33), (0.14, -0.44))):
    tint = ((1.0, 0.5, 0.35), (0.85, 0.9, 0.35), (1.0, 0.72, 0.3))[k]
    group.add("ellipsoid", (0.04, 0.04, 0.038), (x, y, top + 0.1), "plaster", tint=tint, tiles=3.0)
  heights = 0.0
  for k, (w, d, h) in enumerate(((0.13, 0.18, 0.018), (0.12, 0.16, 0.014), (0.1, 0.15, 0.02))):
    place = (-0.05, 0.35, top + heights + h)
    turn = yaw(0.3 * k - 0.2)
    group.add("box", (w, d, h), place, f"poster_{k}", rotation=turn, rounding=0.004, tiles=2.5)
    heights += 2 * h
  group.add("cone", (0.036, 0.04, 0.048), (0.2, 0.12, top + 0.048), "glaze", tiles=3.0)
  screen = Rotation.from_euler("xz", [np.pi / 2 - 0.2, np.pi / 2]).as_matrix()
  keys, place = (0.16, 0.11, 0.008), (-0.08, -0.02, top + 0.008)
  group.add("box", keys, place, "slate", rotation=yaw(np.pi / 2))
  panel, place = (0.16, 0.105, 0.006), (-0.215, -0.02, top + 0.115)
  group.add("box", panel, place, "poster_0", rotation=screen, tiles=None)
  return group.solids


def chair() -> list[Solid]:
  """Returns a wooden chair that is half turned from the table."""
  group = Group("chair", (-1.50, 0.30, 0), -1.25)
  wood: dict[str, Any] = {"material": "red_wood", "tiles": 0.8}
  group.add("box", (0.2, 0.2, 0.014), (0, 0, 0.44), rounding=0.008, **wood)
  group.add("box", (0.18, 0.18, 0.025), (0, 0, 0.475), "cloth_ochre", rounding=0.022, tiles=1.5)
  for x in (-0.175, 0.175):
    group.add("box", (0.018, 0.018, 0.215), (x, -0.175, 0.215), rounding=0.004, **wood)
    group.add("box", (0.018, 0.018, 0.45), (x, 0.182, 0.45), rounding=0.004, **wood)
    group.add("box", (0.010, 0.165, 0.012), (x, 0, 0.2), **wood)
  for z, half in ((0.84, 0.05), (0.70, 0.025), (0.60, 0.025)):
    group.add("box", (0.165, 0.010, half), (0, 0.182, z), rounding=0.005, **wood)
  return group.solids


def shelves(rng: np.random.Generator) -> list[Solid]:
  """Returns a bookcase on the south wall, filled with books and small things."""
  group = Group("shelf", (0.0, -1.86, 0), np.pi)  # local -y looks into the room
  width, depth, height, board = 0.95, 0.135, 1.86, 0.012
  wood: dict[str, Any] = {"material": "dark_wood", "tiles": 0.6}
  for side in (-1, 0, 1):
    group.add("box", (board, depth, height / 2), (side * (width - board), 0, height / 2), **wood)
  group.add("box", (width, 0.004, height / 2), (0, depth - 0.004, height / 2), **wood)
  levels = np.array([0.06, 0.42, 0.77, 1.10, 1.43, height - board])
  for z in levels:
    group.add("box", (width, depth, board), (0, 0, z), **wood)
  for bottom, top in zip(levels[:-1] + board, levels[1:] - board, strict=True):
    for bay in (-1, 1):
      _books(group, rng, bay * 0.5 * width, 0.5 * width - 0.03, bottom, top - bottom)
  return group.solids


def _books(group: Group, rng, centre: float, half: float, bottom: float, room: float) -> None:
  """Fills one compartment: upright books, then a thing or a pile in the rest."""
  x, stop = centre - half, centre + half * rng.uniform(0.35, 0.95)
  front = facing((0, -1, 0))
  while x < stop:
    thick = rng.uniform(0.012, 0.028)
    height = rng.uniform(0.55, 0.93) * room / 2
    deep = rng.uniform(0.07, 0.1)
    place = (x + thick, 0.12 - deep - rng.uniform(0, 0.015), bottom + height)
    k = int(rng.integers(art.SPINES))
    window = (k / art.SPINES, 0.0, (k + 1) / art.SPINES, 1.0)
    group.add(
      "box", (thick, height, deep), place, "spines", rotation=front, tiles=None, window=window
    )
    x += 2 * thick + 0.001
  left = centre + half - x
  if left > 0.12:
    middle, choice = x + left / 2, rng.integers(3)
    tint = tuple(rng.uniform(0.55, 1.0, 3))
    if choice == 0:
      radius = min(left / 2 - 0.02, 0.4 * room, 0.085)
      size, place = (radius, radius, radius), (middle, -0.01, bottom + radius)
      group.add("ellipsoid", size, place, "glaze", tint=tint, tiles=2.0)
    elif choice == 1:
      size = (0.045, min(0.07, left / 2), 0.35 * room)
      group.add("cone", size, (middle, -0.01, bottom + size[2]), "glaze", tint=tint, tiles=2.0)
    else:
      size = (min(left / 2 - 0.01, 0.11), 0.09, 0.28 * room)
      place = (middle, -0.01, bottom + size[2])
      group.add("box", size, place, "cardboard", tiles=1.6, tint=tint, rounding=0.004)


def sideboard() -> list[Solid]:
  """Returns a low cupboard in the south-east with a table lamp and a vase."""
  group = Group("sideboard", (1.62, -1.845, 0))
  group.add("box", (0.42, 0.15, 0.33), (0, 0, 0.36), "red_wood", rounding=0.006, tiles=0.7)
  for x in (-0.38, 0.38):
    for y in (-0.11, 0.11):
      group.add("cone", (0.014, 0.02, 0.018), (x, y, 0.018), "dark_wood", tiles=2.0)
  for side in (-1, 1):
    place = (side * 0.205, 0.153, 0.36)
    group.add("box", (0.19, 0.008, 0.29), place, "pale_wood", rounding=0.004, tiles=0.7)
    group.add("ellipsoid", (0.013, 0.016, 0.013), (side * 0.04, 0.172, 0.42), "slate", tiles=3.0)
  group.add("cone", (0.07, 0.05, 0.012), (-0.22, 0, 0.702), "slate", tiles=2.0)
  group.add("cone", (0.012, 0.012, 0.12), (-0.22, 0, 0.83), "slate", tiles=2.0)
  shade: dict[str, Any] = {"material": "cloth_ochre", "tiles": 1.5, "tint": (1.0, 0.96, 0.85)}
  group.add("cone", (0.13, 0.085, 0.09), (-0.22, 0, 1.03), **shade)
  group.add("cone", (0.05, 0.085, 0.11), (0.2, 0.0, 0.80), "glaze", tiles=2.0)
  return group.solids


def boxes() -> list[Solid]:
  """Returns cardboard boxes near the walls that a robot has to go around."""
  group = Group("carton")
  card: dict[str, Any] = {"material": "cardboard", "rounding": 0.004}
  group.add("box", (0.26, 0.2, 0.17), (-1.98, -1.46, 0.17), rotation=yaw(0.2), tiles=1.1, **card)
  group.add("box", (0.17, 0.15, 0.12), (-2.02, -1.47, 0.46), rotation=yaw(-0.35), tiles=1.5, **card)
  group.add("box", (0.16, 0.17, 0.15), (2.2, 0.25, 0.15), rotation=yaw(0.3), tiles=1.3, **card)
  pouf, place = (0.15, 0.15, 0.20), (-1.62, -0.66, 0.20)
  group.add("box", pouf, place, "rug", rotation=yaw(0.5), rounding=0.05)
  return group.solids


def floor_lamp() -> list[Solid]:
  """Returns a standing lamp in the north-west corner."""
  group = Group("lamp", (-2.15, 1.62, 0))
  group.add("cone", (0.15, 0.14, 0.014), (0, 0, 0.014), "slate", tiles=1.5)
  group.add("cone", (0.013, 0.013, 0.68), (0, 0, 0.7), "slate", tiles=1.5)
  shade: dict[str, Any] = {"material": "botanical", "tiles": 1.2, "tint": (1.0, 0.97, 0.88)}
  group.add("cone", (0.22, 0.15, 0.15), (0, 0, 1.5), **shade)
  return group.solids


def pictures() -> list[Solid]:
  """Returns what hangs on the walls: framed posters, a window and a door."""
  group = Group("picture")
  x, y = 0.5 * ROOM_SIZE[0], 0.5 * ROOM_SIZE[1]
  hung = [  # wall normal, place along the wall, height, half width, half height, texture
    ((0, -1, 0), -0.55, 1.52, 0.30, 0.38, "poster_0"),
    ((0, -1, 0), 0.25, 1.58, 0.36, 0.26, "poster_1"),
    ((0, -1, 0), 0.98, 1.50, 0.22, 0.30, "poster_2"),
    ((0, -1, 0), -1.45, 1.45, 0.24, 0.32, "poster_5"),
    ((-1, 0, 0), 0.62, 1.42, 0.34, 0.48, "poster_3"),
    ((-1, 0, 0), -0.30, 1.48, 0.28, 0.36, "poster_4"),
    ((1, 0, 0), -1.15, 1.40, 0.36, 0.50, "poster_5"),
    ((1, 0, 0), 0.42, 1.55, 0.62, 0.48, "window"),
    ((0, 1, 0), -1.65, 1.40, 0.38, 0.46, "poster_6"),
    ((0, 1, 0), 1.62, 1.62, 0.40, 0.30, "poster_7"),
    ((-1, 0, 0), -1.28, 1.02, 0.43, 1.02, "door"),
  ]
  for normal, along, height, half_width, half_height, material in hung:
    rotation = facing(normal)
    tangent = np.array([abs(normal[1]), abs(normal[0]), 0.0])
    wall = -np.asarray(normal) * (x if normal[0] else y)
    for depth, grow, look in (
      (0.010, 0.03, {"material": "pale_wood" if material == "door" else "dark_wood", "tiles": 0.8}),
      (0.012, 0.0, {"material": material, "tiles": None}),
    ):
      place = wall + along * tangent + [0, 0, height] + depth * np.asarray(normal)
      lift = 0.0 if material != "door" else 0.5 * grow
      size = (half_width + grow, half_height + grow - lift, depth)
      place[2] += lift
      group.add("box", size, place, rotation=rotation, **look)
  return group.solids


def furnish(rng: np.random.Generator) -> list[Solid]:
  """Returns every solid of the room."""
  pieces = [shell(), marker_sheet(), sofa(), table(), chair(), shelves(rng), sideboard()]
  pieces += [boxes(), floor_lamp(), plant(rng), pictures()]
  return [solid for piece in pieces for solid in piece]
