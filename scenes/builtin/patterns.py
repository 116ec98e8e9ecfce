"""Procedural patterns of the built-in room: wallpaper, rug, cardboard and the printed marker.

Textures are float [H, W, 3] in [0, 255] where not said otherwise.
"""

import cv2
import numpy as np

from nerf2real.scenes.builtin.textures import noise, tinted

MARKER_CELLS = 6  # DICT_4X4: four cells of code and one of border on each side
_RUG_COLOURS = np.array(
  [[196, 160, 96], [40, 58, 92], [206, 192, 164], [150, 82, 52], [66, 88, 76], [92, 34, 40]], float
)


def botanical(rng: np.random.Generator, shape: tuple[int, int], *, stems: int) -> np.ndarray:
  """Returns wallpaper with scattered sprigs, none like another, float [H, W, 3]."""
  height, width = shape
  picture = tinted(noise(rng, shape, slope=1.1), (190, 196, 178), (226, 226, 208)).copy()
  scale = np.sqrt(height * width / stems)
  for _ in range(stems):
    root = rng.uniform(0, [width, height])
    heading = rng.uniform(0, 2 * np.pi)
    leaf = rng.uniform([40, 84, 66], [118, 142, 110])
    flower = rng.uniform([130, 50, 50], [226, 170, 130])
    steps = int(rng.integers(4, 8))
    for step in range(steps):
      heading += rng.normal(0, 0.35)
      tip = root + 0.16 * scale * np.array([np.cos(heading), np.sin(heading)])
      cv2.line(picture, _point(root), _point(tip), (leaf * 0.8).tolist(), 2, cv2.LINE_AA)
      for side in (-1, 1):
        angle = heading + side * rng.uniform(0.6, 1.1)
        size = scale * rng.uniform(0.07, 0.13)
        centre = tip + size * np.array([np.cos(angle), np.sin(angle)])
        colour = leaf * rng.uniform(0.8, 1.2)
        _ellipse(picture, centre, (size, 0.4 * size), angle, colour)
        _line_from(picture, centre, size, angle, colour * 0.7)
      root = tip
      if step == steps - 1:
        _flower(picture, rng, tip, scale * rng.uniform(0.07, 0.13), flower)
  return cv2.GaussianBlur(picture, (0, 0), 0.9)


def _point(p: np.ndarray) -> tuple[int, int]:
  return round(p[0]), round(p[1])


def _ellipse(picture, centre, axes, angle, colour) -> None:
  size = (max(int(axes[0]), 1), max(int(axes[1]), 1))
  degrees = float(np.degrees(angle))
  cv2.ellipse(picture, _point(centre), size, degrees, 0, 360, colour, -1, cv2.LINE_AA)


def _line_from(picture, centre, size, angle, colour) -> None:
  half = 0.8 * size * np.array([np.cos(angle), np.sin(angle)])
  cv2.line(picture, _point(centre - half), _point(centre + half), colour, 1, cv2.LINE_AA)


def _flower(picture, rng, centre, size, colour) -> None:
  petals = int(rng.integers(5, 8))
  for k in range(petals):
    angle = 2 * np.pi * (k + rng.uniform(0, 0.3)) / petals
    middle = centre + 0.7 * size * np.array([np.cos(angle), np.sin(angle)])
    _ellipse(picture, middle, (0.7 * size, 0.4 * size), angle, colour * rng.uniform(0.85, 1.15))
  _ellipse(picture, centre, (0.35 * size, 0.35 * size), 0.0, (222, 190, 80))


def rug(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  """Returns a woven rug: borders, a field of hand-knotted motifs that differ, float [H, W, 3]."""
  height, width = shape
  ground = np.array([120.0, 48, 44])
  picture = np.tile(ground, (height, width, 1))
  margin = int(0.035 * width)
  for k, colour in enumerate([1, 0, 5, 2, 1]):
    inset = k * margin // 2
    cv2.rectangle(
      picture, (inset, inset), (width - 1 - inset, height - 1 - inset), _RUG_COLOURS[colour], -1
    )
  inset = int(2.6 * margin)
  picture[inset:-inset, inset:-inset] = ground
  cell = int(0.075 * width)
  for y in range(inset + cell // 2, height - inset, cell):
    for x in range(inset + cell // 2, width - inset, cell):
      centre = np.array([x, y]) + rng.uniform(-0.12, 0.12, 2) * cell
      for ring in range(3):
        size = cell * (0.52 - 0.16 * ring) * rng.uniform(0.8, 1.1)
        sides = int(rng.choice([4, 6, 8]))
        angle = np.arange(sides) * 2 * np.pi / sides + rng.choice([0, np.pi / sides])
        corners = centre + size * np.stack([np.cos(angle), np.sin(angle)], -1)
        colour = _RUG_COLOURS[rng.integers(len(_RUG_COLOURS))] * rng.uniform(0.85, 1.1)
        cv2.fillPoly(picture, [np.rint(corners).astype(np.int32)], colour, cv2.LINE_AA)
  for _ in range(160):
    x, y = rng.integers(0, [width, height])
    size = int(rng.uniform(0.15, 0.3) * margin)
    cv2.circle(picture, (int(x), int(y)), size, _RUG_COLOURS[rng.integers(6)], -1, cv2.LINE_AA)
  weave = 1 + 0.07 * noise(rng, shape, slope=0.8, stretch=(1.0, 2.0))
  weave += 0.05 * noise(rng, shape, slope=1.5)
  return cv2.GaussianBlur(picture, (0, 0), 1.0) * weave[..., None]


def cardboard(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  """Returns worn cardboard with tape, stamps and scribbled lines, float [H, W, 3]."""
  height, width = shape
  picture = tinted(noise(rng, shape, slope=1.2), (150, 112, 72), (190, 152, 106)).copy()
  picture[int(0.45 * height) : int(0.55 * height)] *= [0.86, 0.84, 0.78]
  for _ in range(10):
    corner = rng.uniform(0, [width, height])
    size = rng.uniform(0.04, 0.2, 2) * [width, 0.5 * height]
    thickness = int(rng.choice([2, 3, -1]))
    colour = rng.uniform(20, 110, 3) if rng.random() < 0.7 else rng.uniform(190, 235, 3)
    cv2.rectangle(picture, _point(corner), _point(corner + size), colour.tolist(), thickness)
  for _ in range(26):
    start = rng.uniform(0, [width, height])
    stop = start + rng.normal(0, 0.05, 2) * width
    ink = rng.uniform(20, 90, 3).tolist()
    cv2.line(picture, _point(start), _point(stop), ink, 2, cv2.LINE_AA)
  return cv2.GaussianBlur(picture, (0, 0), 0.8)


def marker(identity: int, *, cell: int, margin_cells: float) -> np.ndarray:
  """Returns an ArUco marker of DICT_4X4_50 with a white margin, uint8 [S, S, 3].

  Args:
    identity: Index in the dictionary.
    cell: Size of one cell [pixel]; the marker is MARKER_CELLS cells wide.
    margin_cells: Width of the white margin [cell].
  """
  dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
  code = cv2.aruco.generateImageMarker(dictionary, identity, MARKER_CELLS * cell)
  border = round(margin_cells * cell)
  code = np.pad(np.clip(code, 22, 236), border, constant_values=236)
  return np.repeat(code[..., None], 3, axis=-1)
