"""Furniture of drawn rooms: each piece has its back to local +y and knows what it covers."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nerf2real.scenes.builtin.placing import Group

Random = np.random.Generator
Builder = Callable[[Group, Random], None]


class Piece(NamedTuple):
  """A kind of furniture in one size."""

  name: str
  width: float  # m along the wall
  depth: float  # m into the room
  build: Builder  # adds its solids about the middle of what it covers


def _box(group: Group, low, high, material: str, **look: Any) -> None:
  """Adds a box between two corners [m]."""
  low, high = np.asarray(low, float), np.asarray(high, float)
  group.add("box", (high - low) / 2, (low + high) / 2, material, **look)


def _legs(group: Group, half_x: float, half_y: float, height: float, thick: float, wood: str):
  for x in (-half_x, half_x):
    for y in (-half_y, half_y):
      _box(group, (x - thick, y - thick, 0), (x + thick, y + thick, height), wood)


def bed(random: Random) -> Piece:
  """Returns a bed whose side stands at the wall."""
  width, depth = random.uniform(1.9, 2.1), random.uniform(0.9, 1.5)

  def build(group: Group, random: Random) -> None:
    x, y, low = width / 2, depth / 2, random.choice((0.0, 0.12))
    _box(group, (-x, -y, low), (x, y, 0.3), "wood", tiles=0.6)
    _box(group, (-x + 0.03, -y + 0.02, 0.3), (x - 0.03, y - 0.02, 0.5), "cover", rounding=0.05)
    _box(group, (-x, -y, 0.2), (-x + 0.04, y, 0.9), "wood", tiles=0.6)
    _box(group, (-x + 0.1, -y + 0.15, 0.48), (-x + 0.5, y - 0.15, 0.6), "white", rounding=0.055)
    if low:
      _legs(group, x - 0.06, y - 0.06, low, 0.03, "wood")

  return Piece("bed", width, depth, build)


def wardrobe(random: Random) -> Piece:
  """Returns a wardrobe with plain doors."""
  width, height = random.uniform(0.8, 1.6), random.uniform(1.7, 2.1)
  material = str(random.choice(("white", "lacquer", "wood")))

  def build(group: Group, random: Random) -> None:
    x = width / 2
    _box(group, (-x, -0.26, 0.0), (x, 0.28, height), material, tiles=0.5)
    doors = 2 if width < 1.2 else 3
    for k in range(doors):
      left, right = (-x + width * (k + s) / doors for s in (0.02, 0.98))
      _box(group, (left, -0.28, 0.08), (right, -0.26, height - 0.03), material, tiles=0.5)
      _box(group, (right - 0.05, -0.3, 0.95), (right - 0.03, -0.28, 1.1), "metal")

  return Piece("wardrobe", width, 0.6, build)


def desk(random: Random) -> Piece:
  """Returns a desk with a screen and things on it."""
  width, top = random.uniform(1.0, 1.6), random.uniform(0.70, 0.76)

  def build(group: Group, random: Random) -> None:
    x = width / 2
    _box(group, (-x, -0.33, top - 0.03), (x, 0.35, top), "white", tiles=0.7)
    _legs(group, x - 0.05, 0.29, top - 0.03, 0.025, "metal")
    _box(group, (-0.28, 0.14, top + 0.12), (0.28, 0.17, top + 0.46), "black")
    _box(group, (-0.04, 0.15, top), (0.04, 0.19, top + 0.14), "black")
    _box(group, (-0.2, -0.18, top), (0.2, -0.05, top + 0.02), "black")
    for _ in range(int(random.integers(1, 4))):
      place, size = random.uniform(-0.8, 0.8) * x, random.uniform(0.04, 0.1)
      group.add("cone", (size / 2, size / 2, size), (place, -0.2, top + size), "lacquer")
    if random.uniform() < 0.6:  # a chest of drawers below
      _box(group, (x - 0.45, -0.28, 0.04), (x - 0.1, 0.3, top - 0.05), "white", tiles=0.7)

  return Piece("desk", width, 0.7, build)


def shelf(random: Random) -> Piece:
  """Returns an open shelf with boxes and books."""
  width, height = random.uniform(0.6, 1.2), random.uniform(0.8, 1.9)

  def build(group: Group, random: Random) -> None:
    x, levels = width / 2, max(int(height / 0.36), 2)
    for side in (-x, x - 0.02):
      _box(group, (side, -0.15, 0), (side + 0.02, 0.15, height), "wood", tiles=0.6)
    _box(group, (-x, 0.14, 0), (x, 0.15, height), "wood", tiles=0.6)
    edges = np.linspace(0.04, height - 0.02, levels + 1)
    for low, high in itertools.pairwise(edges):
      _box(group, (-x, -0.15, low), (x, 0.15, low + 0.02), "wood", tiles=0.6)
      at = -x + 0.04
      while at < x - 0.1 and random.uniform() < 0.93:
        thick = random.uniform(0.02, 0.16)
        thick = min(thick, x - 0.04 - at)
        tall = random.uniform(0.5, 0.9) * (high - low)
        material = f"poster_{random.integers(6)}" if thick < 0.06 else "card"
        tint = tuple(random.uniform(0.6, 1.0, 3))
        front = random.uniform(-0.14, -0.08)
        end = (at + thick, 0.13, low + 0.02 + tall)
        _box(group, (at, front, low + 0.02), end, material, tint=tint, tiles=1.5)
        at += thick + random.uniform(0.0, 0.06)
    _box(group, (-x, -0.15, height - 0.02), (x, 0.15, height), "wood", tiles=0.6)

  return Piece("shelf", width, 0.32, build)


def couch(random: Random) -> Piece:
  """Returns a couch for one to three."""
  width = random.uniform(0.9, 2.1)

  def build(group: Group, random: Random) -> None:
    x, seat = width / 2, random.uniform(0.38, 0.46)
    cloth: dict[str, Any] = {"material": "cloth", "tiles": 1.1}
    _box(group, (-x, -0.4, 0.06), (x, 0.4, seat), rounding=0.05, **cloth)
    _box(group, (-x, 0.2, 0.1), (x, 0.42, 0.82), rounding=0.08, **cloth)
    for side in (-x, x - 0.16):
      _box(group, (side, -0.4, 0.06), (side + 0.16, 0.4, seat + 0.18), rounding=0.06, **cloth)
    _legs(group, x - 0.06, 0.34, 0.08, 0.025, "dark")
    if random.uniform() < 0.7:
      low = (0.2 * x, 0.0, seat + 0.01)
      _box(group, low, (0.2 * x + 0.4, 0.14, seat + 0.36), "cover", rounding=0.06)

  return Piece("couch", width, 0.86, build)


def television(random: Random) -> Piece:
  """Returns a low board with a black screen."""
  width = random.uniform(1.1, 1.7)

  def build(group: Group, random: Random) -> None:
    x, top = width / 2, random.uniform(0.4, 0.55)
    _box(group, (-x, -0.2, 0.05), (x, 0.2, top), "white", tiles=0.6)
    _legs(group, x - 0.05, 0.15, 0.05, 0.02, "metal")
    _box(group, (-0.45 * width, 0.05, top + 0.06), (0.45 * width, 0.09, top + 0.6), "black")
    _box(group, (-0.15, 0.0, top), (0.15, 0.14, top + 0.08), "black")

  return Piece("television", width, 0.42, build)


def radiator(random: Random) -> Piece:
  """Returns a white radiator with fins."""
  width = random.uniform(0.6, 1.3)

  def build(group: Group, random: Random) -> None:
    x = width / 2
    _box(group, (-x, 0.0, 0.12), (x, 0.02, 0.7), "white")
    for at in np.arange(-x, x - 0.02, 0.05):
      _box(group, (at, -0.04, 0.12), (at + 0.02, 0.0, 0.7), "white")

  return Piece("radiator", width, 0.12, build)


def table(random: Random) -> Piece:
  """Returns a round or a square table with one leg or four."""
  size, top = random.uniform(0.5, 1.0), random.uniform(0.42, 0.75)
  is_round = random.uniform() < 0.5

  def build(group: Group, random: Random) -> None:
    x = size / 2
    if is_round:
      group.add("cone", (x, x, 0.015), (0, 0, top - 0.015), "wood", tiles=0.8)
      group.add("cone", (0.04, 0.03, top / 2 - 0.03), (0, 0, top / 2), "dark")
      group.add("cone", (0.5 * x, 0.45 * x, 0.015), (0, 0, 0.015), "dark")
    else:
      _box(group, (-x, -x, top - 0.03), (x, x, top), "wood", tiles=0.8)
      _legs(group, x - 0.04, x - 0.04, top - 0.03, 0.025, "wood")
    group.add("cone", (0.05, 0.08, 0.05), (0.3 * x, 0.2 * x, top + 0.05), "lacquer")

  return Piece("table", size, size, build)


def seat(random: Random) -> Piece:
  """Returns a chair with thin legs."""

  def build(group: Group, random: Random) -> None:
    _box(group, (-0.21, -0.21, 0.43), (0.21, 0.21, 0.46), "wood", tiles=0.8)
    _legs(group, 0.19, 0.19, 0.43, 0.014, "metal")
    for x in (-0.19, 0.19):
      _box(group, (x - 0.014, 0.18, 0.46), (x + 0.014, 0.21, 0.88), "metal")
    _box(group, (-0.2, 0.18, 0.66), (0.2, 0.21, 0.88), "wood", tiles=0.8)

  return Piece("seat", 0.46, 0.46, build)


def clutter(random: Random) -> Piece:
  """Returns one thing that lies about: a carton, a basket, a ball, a plant."""
  kind = str(random.choice(("carton", "basket", "ball", "plant")))
  size = random.uniform(0.15, 0.4)

  def build(group: Group, random: Random) -> None:
    x = size / 2
    if kind == "carton":
      tall = random.uniform(0.5, 1.2) * size
      _box(group, (-x, -0.8 * x, 0), (x, 0.8 * x, tall), "card", rounding=0.004, tiles=1.4)
    elif kind == "basket":
      group.add("cone", (0.8 * x, x, 0.6 * size), (0, 0, 0.6 * size), "cloth", tiles=2.0)
    elif kind == "ball":
      radius = max(0.4 * x, 0.06)
      group.add("ellipsoid", (radius, radius, radius), (0, 0, radius), "lacquer", tiles=2.0)
    else:
      group.add("cone", (0.7 * x, x, 0.15), (0, 0, 0.15), "lacquer", tiles=2.0)
      for k in range(12):
        angle, lean = 2.4 * k, random.uniform(0.3, 0.9)
        place = (0.5 * x * np.cos(angle), 0.5 * x * np.sin(angle), 0.3 + random.uniform(0.1, 0.5))
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0]])
        turn = np.vstack([turn, [0, 0, 1]]) @ _pitched(lean)
        group.add("ellipsoid", (0.14, 0.04, 0.006), place, "leaf", rotation=turn, tiles=None)

  return Piece("clutter", size, size, build)


def _pitched(angle: float) -> np.ndarray:
  c, s = np.cos(angle), np.sin(angle)
  return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


AT_WALLS = (bed, wardrobe, desk, shelf, couch, television, radiator)
ABOUT = (table, seat, seat, clutter, clutter)
