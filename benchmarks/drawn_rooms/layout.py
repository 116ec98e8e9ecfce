"""Draws a room: its plan, what hangs on its walls, what stands at them and about."""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.drawn_rooms import looks, pieces
from nerf2real.core.geometry.rotations import yaw_matrix
from nerf2real.scenes.builtin import furniture
from nerf2real.scenes.builtin.placing import Group, facing
from nerf2real.scenes.builtin.room import TrueRoom
from nerf2real.scenes.builtin.solids import Solid

Random = np.random.Generator

_NORMALS = ((0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0))  # of the walls, into the room
_THICK = 0.05  # half of a wall's [m]
_OFF_WALL = 0.01  # m
_FREE_SHARE = 0.38  # of the floor that furniture leaves alone, at least
_PATH = 0.5  # m between what stands about and anything else: room for a robot
_TRIES = 30


class Layout(NamedTuple):
  """A room, and where its marker lies."""

  room: TrueRoom
  marker: tuple[float, float, float]  # x, y [m], turn [rad]


class _Cover:
  """What of the floor is taken, as turned rectangles."""

  def __init__(self, size: tuple[float, float, float]):
    self.half = np.array(size[:2]) / 2
    self.rectangles: list[tuple[np.ndarray, np.ndarray, float]] = []

  def take(self, centre: np.ndarray, half: np.ndarray, angle: float) -> None:
    self.rectangles.append((np.asarray(centre, float)[:2], np.asarray(half, float), angle))

  def distance(self, points: np.ndarray) -> np.ndarray:
    """Returns the distance from points [P, 2] to what is taken or outside [P] [m]."""
    found = (self.half - np.abs(points)).min(axis=-1)
    for centre, half, angle in self.rectangles:
      local = (points - centre) @ yaw_matrix(angle)[:2, :2]
      beyond = np.abs(local) - half
      outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)
      found = np.minimum(found, outside)
    return found

  def is_free(self, centre, half, angle: float, gap: float) -> bool:
    """Tells whether a rectangle keeps a gap [m] from all that is taken."""
    u = np.linspace(-1, 1, 15)
    grid = np.stack(np.meshgrid(u * half[0], u * half[1]), -1).reshape(-1, 2)
    points = grid @ yaw_matrix(angle)[:2, :2].T + np.asarray(centre, float)[:2]
    return bool(self.distance(points).min() > gap)


def draw(random: Random) -> Layout:
  """Returns a furnished room."""
  size = (random.uniform(3.4, 5.8), random.uniform(3.0, 4.6), random.uniform(2.35, 2.75))
  cover = _Cover(size)
  things = _shell(size)
  if random.uniform() < 0.4:
    things += _corner(size, random, cover)
  things += _hung(size, random, cover)
  for number in range(int(random.integers(4, 8))):
    if _free_share(cover, size) < _FREE_SHARE:
      break
    piece = pieces.AT_WALLS[random.integers(len(pieces.AT_WALLS))](random)
    things += _at_wall(piece, number, size, random, cover)
  for number in range(int(random.integers(2, 6))):
    piece = pieces.ABOUT[random.integers(len(pieces.ABOUT))](random)
    things += _about(piece, number, size, random, cover)
  marker, sheet = _marker(size, random, cover)
  return Layout(TrueRoom(tuple(things + sheet), size), marker)


def _free_share(cover: _Cover, size: tuple[float, float, float]) -> float:
  u, v = (np.linspace(-s / 2, s / 2, 60) for s in size[:2])
  points = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
  return float((cover.distance(points) > 0.2).mean())


def _shell(size: tuple[float, float, float]) -> list[Solid]:
  x, y, z = (0.5 * s for s in size)
  group = Group("shell")
  down = Rotation.from_euler("x", np.pi).as_matrix()
  group.add("box", (x, y, _THICK), (0, 0, -_THICK), "floor", tiles=None)
  top = (0, 0, 2 * z + _THICK)
  group.add("box", (x, y, _THICK), top, "ceiling", rotation=down, tiles=None)
  for k, normal in enumerate(_NORMALS):
    along, away = (x, y) if normal[1] else (y, x)
    place = -(away + _THICK) * np.array(normal) + [0, 0, z]
    group.add("box", (along, z, _THICK), place, f"wall_{k}", rotation=facing(normal), tiles=None)
  return group.solids


def _corner(size, random: Random, cover: _Cover) -> list[Solid]:
  """Returns a corner of the room that is walled off."""
  half = np.array([random.uniform(0.35, 0.75), random.uniform(0.3, 0.6)])
  sign = random.choice((-1, 1), 2)
  centre = sign * (np.array(size[:2]) / 2 - half)
  cover.take(centre, half, 0.0)
  group = Group("shell_corner", (*centre, 0.0))
  group.add("box", (*half, size[2] / 2), (0, 0, size[2] / 2), "white", tiles=0.6)
  return group.solids


def _hung(size, random: Random, cover: _Cover) -> list[Solid]:
  """Returns a door, a window or two, and pictures."""
  group = Group("hung")
  taken: list[tuple[int, float, float]] = []  # wall, place along it, half width
  wall = int(random.integers(4))
  wanted = [("door", 0.43, 1.0, 1.0), ("window", 0.6, 0.5, 1.5)]
  wanted += [("window", random.uniform(0.4, 0.8), 0.5, 1.5)] * int(random.uniform() < 0.4)
  for _ in range(int(random.integers(2, 7))):
    name = f"poster_{random.integers(looks.POSTERS)}"
    wanted.append((name, random.uniform(0.15, 0.4), random.uniform(0.15, 0.4), 1.5))
  for number, (material, width, height, middle) in enumerate(wanted):
    wall = (wall + 2) % 4 if number == 1 else int(random.integers(4)) if number else wall
    normal = np.array(_NORMALS[wall])
    along, away = (size[0], size[1]) if normal[1] else (size[1], size[0])
    at = random.uniform(-0.5, 0.5) * (along - 2 * width - 0.3)
    if any(w == wall and abs(a - at) < width + r + 0.1 for w, a, r in taken):
      continue
    tangent = np.array([abs(normal[1]), abs(normal[0]), 0.0])
    foot = -normal * away / 2 + at * tangent
    if cover.distance(foot[None, :2] + 0.05 * normal[None, :2])[0] < 0.04:  # a corner is there
      continue
    taken.append((wall, at, width))
    place = foot + np.array([0, 0, middle])
    look: dict[str, Any] = {"rotation": facing(tuple(normal))}
    frame = "white" if material in ("window", "door") else "dark"
    lift = 0.02 if material != "door" else 0.0
    size_of = (width + 0.03, height + lift, 0.01)
    group.add("box", size_of, place + 0.01 * normal, frame, tiles=0.8, **look)
    group.add("box", (width, height, 0.012), place + 0.012 * normal, material, tiles=None, **look)
    if material == "door":
      half = np.array([width, 0.45] if normal[1] else [0.45, width])
      cover.take(foot + 0.45 * normal, half, 0.0)
    if material == "window" and random.uniform() < 0.6:
      for side in (-1, 1):
        centre = foot + side * (width + 0.18) * tangent + 0.05 * normal + [0, 0, size[2] / 2]
        folds = (0.18, size[2] / 2 - 0.06, 0.03)
        group.add("box", folds, centre, "curtain", rounding=0.02, tiles=1.0, **look)
  return group.solids


def _at_wall(piece: pieces.Piece, number: int, size, random: Random, cover: _Cover):
  for _ in range(_TRIES):
    normal = np.array(_NORMALS[random.integers(4)])
    along, away = (size[0], size[1]) if normal[1] else (size[1], size[0])
    reach = (along - piece.width) / 2 - 0.02
    if reach < 0:
      continue
    tangent = np.array([abs(normal[1]), abs(normal[0]), 0.0])
    centre = random.uniform(-reach, reach) * tangent
    centre = centre - normal * (away / 2 - piece.depth / 2 - _OFF_WALL)
    angle = float(np.arctan2(normal[0], -normal[1]))  # local -y looks into the room
    half = np.array([piece.width, piece.depth]) / 2
    if cover.is_free(centre, half, angle, 0.005):
      cover.take(centre, half, angle)
      group = Group(f"{piece.name}_{number}", centre, angle)
      piece.build(group, random)
      return group.solids
  return []


def _about(piece: pieces.Piece, number: int, size, random: Random, cover: _Cover):
  for _ in range(_TRIES):
    centre = np.array([*(random.uniform(-0.45, 0.45, 2) * size[:2]), 0.0])
    angle, half = random.uniform(-np.pi, np.pi), np.array([piece.width, piece.depth]) / 2
    if cover.is_free(centre, half, angle, _PATH):
      cover.take(centre, half, angle)
      group = Group(f"about_{piece.name}_{number}", centre, angle)
      piece.build(group, random)
      return group.solids
  return []


def _marker(size, random: Random, cover: _Cover):
  """Returns where the marker lies, and its sheet."""
  points = random.uniform(-0.5, 0.5, (400, 2)) * size[:2]
  x, y = points[int(np.argmax(cover.distance(points)))]
  turn = random.uniform(-np.pi, np.pi)
  group = Group("marker", (x, y, 0.0), turn)
  half = furniture.MARKER_SIZE * (0.5 + furniture.MARKER_MARGIN_CELLS / 6)
  group.add("box", (half, half, 0.00075), (0, 0, 0.00075), "marker", tiles=None)
  return (float(x), float(y), float(turn)), group.solids
