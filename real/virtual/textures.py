"""Procedural textures of the built-in room: every picture is computed from a seed.

Textures are uint8 [H, W, 3]. Power-law noise gives structure at every scale, as real surfaces have:
features for SIFT from near and far, and little energy at the finest scale, so that nothing aliases.
"""

import cv2
import numpy as np

MARKER_CELLS = 6  # DICT_4X4: four cells of code and one of border on each side


def noise(rng: np.random.Generator, shape: tuple[int, int], *, slope=1.0, stretch=(1.0, 1.0)):
  """Returns tileable noise [H, W], amplitude spectrum 1/f^slope, mean 0, standard deviation 1.

  Args:
    rng: Source of randomness.
    shape: Height and width [pixel].
    slope: Exponent of the amplitude spectrum; larger is smoother.
    stretch: Length of the structures along y and x (wood grain: one large, one small).
  """
  height, width = shape
  fy = np.fft.fftfreq(height)[:, None] * stretch[0]
  fx = np.fft.rfftfreq(width)[None] * stretch[1]
  radius = np.sqrt(fy * fy + fx * fx)
  radius[0, 0] = np.inf
  amplitude = radius**-slope * np.exp(-((radius / (0.22 * max(stretch))) ** 2))
  spectrum = np.fft.rfft2(rng.standard_normal(shape)) * amplitude
  picture = np.fft.irfft2(spectrum, s=shape)
  return (picture - picture.mean()) / picture.std()


def to_uint8(picture: np.ndarray) -> np.ndarray:
  """Rounds a picture with values in [0, 255] and clips it."""
  return np.ascontiguousarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8))


def tinted(field: np.ndarray, dark, light) -> np.ndarray:
  """Maps a field [H, W] of standard deviation 1 onto the line between two colours [H, W, 3]."""
  t = np.clip(0.5 + 0.22 * field, -0.1, 1.1)[..., None]
  return np.asarray(dark, float) * (1 - t) + np.asarray(light, float) * t


def wood(rng: np.random.Generator, shape: tuple[int, int], *, dark, light) -> np.ndarray:
  """Returns wood with its grain along x, float [H, W, 3]."""
  grain = noise(rng, shape, slope=1.0, stretch=(1.0, 12.0))
  warp = noise(rng, shape, slope=1.9, stretch=(1.0, 3.0))
  rings = np.sin(6.0 * warp + 0.8 * grain)
  return tinted(0.8 * grain + 0.9 * rings + 0.5 * warp, dark, light)


def planks(
  rng: np.random.Generator, shape: tuple[int, int], *, rows: int, dark, light, mean_length=0.35
) -> np.ndarray:
  """Returns boards along x with seams, knots and boards of different tint, float [H, W, 3]."""
  height, width = shape
  source = wood(rng, shape, dark=dark, light=light)
  picture = np.empty((height, width, 3))
  edges = np.linspace(0, height, rows + 1).astype(int)
  for top, bottom in zip(edges[:-1], edges[1:], strict=True):
    left = -int(rng.uniform(0, mean_length) * width)
    while left < width:
      right = left + int(rng.uniform(0.7, 1.3) * mean_length * width)
      a, b = max(left, 0), min(right, width)
      if b > a:
        board = np.roll(source, tuple(rng.integers(0, [height, width])), (0, 1))
        board = board[top:bottom, a:b] * rng.uniform(0.78, 1.12) * rng.uniform(0.96, 1.04, 3)
        for _ in range(rng.poisson(1.2)):
          _knot(board, rng)
        picture[top:bottom, a:b] = board
        picture[top:bottom, max(b - 2, 0) : b] *= 0.55
      left = right
    picture[max(bottom - 2, 0) : bottom] *= 0.6
  return picture


def _knot(board: np.ndarray, rng: np.random.Generator) -> None:
  height, width = board.shape[:2]
  y, x = np.mgrid[:height, :width]
  radius = rng.uniform(0.06, 0.16) * height
  r = np.hypot((x - rng.uniform(0, width)) / 1.8, y - rng.uniform(0, height)) / radius
  board *= (1 - 0.55 * np.exp(-(r**2)) * (1 + 0.3 * np.cos(5 * r)))[..., None]


def bricks(rng: np.random.Generator, shape: tuple[int, int], *, rows: int, columns: int):
  """Returns a wall of painted bricks in running bond, each with its own tint, float [H, W, 3]."""
  height, width = shape
  picture = tinted(noise(rng, shape, slope=0.8), (176, 168, 156), (204, 197, 186))
  grit = noise(rng, shape, slope=0.9)
  soft = noise(rng, shape, slope=1.6)
  h, w = height / rows, width / columns
  for row in range(rows):
    for column in range(-1, columns + 1):
      x0 = (column + 0.5 * (row % 2)) * w + rng.uniform(0.02, 0.05) * w
      x1, y0 = x0 + w * rng.uniform(0.9, 0.94), row * h + 0.06 * h
      window = np.s_[int(y0) : int(y0 + 0.86 * h), max(int(x0), 0) : max(int(x1), 0)]
      tint = np.array([168, 98, 74]) * rng.uniform(0.62, 1.22) * rng.uniform(0.9, 1.1, 3)
      face = 1 + 0.10 * grit[window] + 0.06 * soft[window]
      picture[window] = tint * face[..., None]
  return cv2.GaussianBlur(picture, (0, 0), 1.2)


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
      cv2.line(picture, _point(root), _point(tip), leaf * 0.8, 2, cv2.LINE_AA)
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
  return int(round(p[0])), int(round(p[1]))


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


def plaster(rng: np.random.Generator, shape: tuple[int, int], *, dark, light) -> np.ndarray:
  """Returns limewashed plaster: clouds, brush strokes and small stains, float [H, W, 3]."""
  clouds = noise(rng, shape, slope=1.5)
  strokes = noise(rng, shape, slope=1.0, stretch=(2.5, 1.0))
  spots = np.maximum(noise(rng, shape, slope=0.7) - 1.1, 0)
  return tinted(0.9 * clouds + 0.7 * strokes - 1.5 * spots, dark, light)


def rug(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  """Returns a woven rug: borders, a field of hand-knotted motifs that differ, float [H, W, 3]."""
  height, width = shape
  ground = np.array([120.0, 48, 44])
  picture = np.tile(ground, (height, width, 1))
  palette = np.array(
    [[196, 160, 96], [40, 58, 92], [206, 192, 164], [150, 82, 52], [66, 88, 76], [92, 34, 40]], float
  )
  margin = int(0.035 * width)
  for k, colour in enumerate([1, 0, 5, 2, 1]):
    inset = k * margin // 2
    cv2.rectangle(
      picture, (inset, inset), (width - 1 - inset, height - 1 - inset), palette[colour], -1
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
        colour = palette[rng.integers(len(palette))] * rng.uniform(0.85, 1.1)
        cv2.fillPoly(picture, [np.rint(corners).astype(np.int32)], colour, cv2.LINE_AA)
  for _ in range(160):
    x, y = rng.integers(0, [width, height])
    size = int(rng.uniform(0.15, 0.3) * margin)
    cv2.circle(picture, (int(x), int(y)), size, palette[rng.integers(6)], -1, cv2.LINE_AA)
  weave = 1 + 0.07 * noise(rng, shape, slope=0.8, stretch=(1.0, 2.0))
  weave += 0.05 * noise(rng, shape, slope=1.5)
  return cv2.GaussianBlur(picture, (0, 0), 1.0) * weave[..., None]


def fabric(rng: np.random.Generator, shape: tuple[int, int], *, dark, light) -> np.ndarray:
  """Returns melange cloth with a faint large pattern, float [H, W, 3]."""
  threads = noise(rng, shape, slope=0.8, stretch=(1, 2.5))
  threads = threads + noise(rng, shape, slope=0.8, stretch=(2.5, 1))
  clouds = noise(rng, shape, slope=1.4)
  pattern = np.sign(noise(rng, shape, slope=1.6)) * 0.5
  return tinted(0.55 * threads + 0.7 * clouds + cv2.GaussianBlur(pattern, (0, 0), 2), dark, light)


def leaf(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  """Returns foliage: green with veins, the midrib along x in the middle, float [H, W, 3]."""
  height, width = shape
  y, x = np.mgrid[:height, :width]
  v = np.abs(y / height - 0.5) * 2
  veins = np.cos(2 * np.pi * (x / width * 9 - v * 2.2)) ** 16
  base = tinted(noise(rng, shape, slope=1.3), (24, 66, 30), (86, 138, 58))
  light = np.maximum(0.5 * veins * (1 - v), np.exp(-((v / 0.06) ** 2)))[..., None]
  return base * (1 - light) + np.array([146, 178, 96]) * light


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
    cv2.rectangle(picture, _point(corner), _point(corner + size), colour, thickness)
  for _ in range(26):
    start = rng.uniform(0, [width, height])
    stop = start + rng.normal(0, 0.05, 2) * width
    cv2.line(picture, _point(start), _point(stop), rng.uniform(20, 90, 3), 2, cv2.LINE_AA)
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
