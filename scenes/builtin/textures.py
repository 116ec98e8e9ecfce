"""Procedural textures of the built-in room: every picture is computed from a seed.

Textures are float [H, W, 3], levels of 0 to 255, which `to_uint8` rounds. Power-law noise gives
structure at every scale, as real surfaces have: features for SIFT from near and far, and little
energy at the finest scale, so that nothing aliases.
"""

import functools
import itertools

import cv2
import numpy as np

_PLANK = 0.35  # mean length of a board, of the picture's width


def noise(rng: np.random.Generator, shape: tuple[int, int], *, slope=1.0, stretch=(1.0, 1.0)):
  """Returns tileable noise [H, W], amplitude spectrum 1/f^slope, mean 0, standard deviation 1.

  Args:
    rng: Source of randomness.
    shape: Height and width [pixel].
    slope: Exponent of the amplitude spectrum; larger is smoother.
    stretch: Length of the structures along y and x (wood grain: one large, one small).
  """
  spectrum = np.fft.rfft2(rng.standard_normal(shape)) * _amplitude(shape, slope, stretch)
  picture = np.fft.irfft2(spectrum, s=shape)
  return (picture - picture.mean()) / picture.std()


@functools.lru_cache(maxsize=16)
def _amplitude(shape: tuple[int, int], slope: float, stretch: tuple[float, float]) -> np.ndarray:
  """Returns the spectrum of `noise` [H, W // 2 + 1], kept for the textures of one size."""
  height, width = shape
  fy = np.fft.fftfreq(height)[:, None] * stretch[0]
  fx = np.fft.rfftfreq(width)[None] * stretch[1]
  radius = np.sqrt(fy * fy + fx * fx)
  radius[0, 0] = np.inf
  return radius**-slope * np.exp(-((radius / (0.22 * max(stretch))) ** 2))


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
  rng: np.random.Generator, shape: tuple[int, int], *, rows: int, dark, light
) -> np.ndarray:
  """Returns boards along x with seams, knots and boards of different tint, float [H, W, 3]."""
  height, width = shape
  source = wood(rng, shape, dark=dark, light=light)
  picture = np.empty((height, width, 3))
  edges = np.linspace(0, height, rows + 1).astype(int)
  for top, bottom in itertools.pairwise(edges):
    left = -int(rng.uniform(0, _PLANK) * width)
    while left < width:
      right = left + int(rng.uniform(0.7, 1.3) * _PLANK * width)
      a, b = max(left, 0), min(right, width)
      if b > a:
        down, along = rng.integers(0, [height, width])
        board = source[
          np.ix_(np.arange(top - down, bottom - down), np.arange(a - along, b - along))
        ]
        board = board * rng.uniform(0.78, 1.12) * rng.uniform(0.96, 1.04, 3)
        for _ in range(rng.poisson(3.0)):
          _knot(board, rng)
        picture[top:bottom, a:b] = board
        picture[top:bottom, max(b - 2, 0) : b] *= 0.55
      left = right
    picture[max(bottom - 2, 0) : bottom] *= 0.6
  return picture


def _knot(board: np.ndarray, rng: np.random.Generator) -> None:
  height, width = board.shape[:2]
  y, x = np.mgrid[:height, :width]
  radius = rng.uniform(0.05, 0.17) * height
  r = np.hypot((x - rng.uniform(0, width)) / 1.8, y - rng.uniform(0, height)) / radius
  board *= (1 - 0.62 * np.exp(-(r**2)) * (1 + 0.3 * np.cos(5 * r)))[..., None]


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


def scattered(
  rng: np.random.Generator, picture: np.ndarray, *, count: int, sizes, colours
) -> np.ndarray:
  """Strews rounded chips over a picture, none like another; returns it, float [H, W, 3].

  Args:
    rng: Source of randomness.
    picture: The ground [H, W, 3].
    count: Number of chips.
    sizes: Smallest and largest radius [pixel]; small ones are more frequent.
    colours: Colours of chips, [K, 3].
  """
  height, width = picture.shape[:2]
  picture = np.ascontiguousarray(picture, np.float64)
  for _ in range(count):
    radius = sizes[0] * (sizes[1] / sizes[0]) ** (rng.random() ** 1.5)
    corners = int(rng.integers(4, 8))
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
    reach = radius * rng.uniform(0.6, 1.2, corners)
    centre = rng.uniform(0, [width, height])
    outline = centre + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    colour = np.asarray(colours[rng.integers(len(colours))]) * rng.uniform(0.85, 1.15)
    cv2.fillPoly(picture, [np.rint(outline).astype(np.int32)], colour.tolist(), cv2.LINE_AA)
  return cv2.GaussianBlur(picture, (0, 0), 1.2)


def plaster(rng: np.random.Generator, shape: tuple[int, int], *, dark, light) -> np.ndarray:
  """Returns limewashed plaster: clouds, brush strokes and small stains, float [H, W, 3]."""
  clouds = noise(rng, shape, slope=1.5)
  strokes = noise(rng, shape, slope=1.0, stretch=(2.5, 1.0))
  spots = np.maximum(noise(rng, shape, slope=0.7) - 1.1, 0)
  return tinted(0.9 * clouds + 0.7 * strokes - 1.5 * spots, dark, light)


def fabric(rng: np.random.Generator, shape: tuple[int, int], *, dark, light) -> np.ndarray:
  """Returns melange cloth with a small print, float [H, W, 3]."""
  threads = noise(rng, shape, slope=0.8, stretch=(1, 2.5))
  threads = threads + noise(rng, shape, slope=0.8, stretch=(2.5, 1))
  clouds = noise(rng, shape, slope=1.4)
  cloth = tinted(0.45 * threads + 0.7 * clouds, dark, light)
  dark, light = np.asarray(dark), np.asarray(light)
  colours = [0.7 * dark, 0.5 * light + 116, 0.85 * light + 20]
  return scattered(rng, cloth, count=260, sizes=(4, 13), colours=colours)


def leaf(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  """Returns foliage: green with veins, the midrib along x in the middle, float [H, W, 3]."""
  height, width = shape
  y, x = np.mgrid[:height, :width]
  v = np.abs(y / height - 0.5) * 2
  veins = np.cos(2 * np.pi * (x / width * 9 - v * 2.2)) ** 16
  base = tinted(noise(rng, shape, slope=1.3), (24, 66, 30), (86, 138, 58))
  light = np.maximum(0.5 * veins * (1 - v), np.exp(-((v / 0.06) ** 2)))[..., None]
  return base * (1 - light) + np.array([146, 178, 96]) * light
