"""Procedural pictures for the built-in room: posters, book spines and the view from the window."""

import itertools

import cv2
import numpy as np

from nerf2real.scenes.builtin import textures

SPINES = 48  # books on one sheet of spines
_INKS = np.array([[200, 70, 50], [30, 80, 120], [230, 170, 60], [40, 50, 60], [90, 140, 120]])
_CLOTHS = np.array(  # colours of bindings
  [
    [122, 36, 40],
    [36, 58, 98],
    [44, 84, 62],
    [186, 138, 58],
    [206, 192, 160],
    [52, 48, 50],
    [112, 74, 48],
    [60, 112, 122],
    [142, 142, 140],
    [168, 84, 50],
    [92, 64, 96],
    [220, 212, 196],
  ],
  float,
)


def poster(rng: np.random.Generator, shape: tuple[int, int], *, style: int) -> np.ndarray:
  """Returns an abstract print with a pale border, uint8 [H, W, 3].

  Args:
    rng: Source of randomness.
    shape: Height and width [pixel].
    style: 0 hills, 1 circles, 2 shards, 3 contour lines.
  """
  height, width = shape
  art = (_hills, _circles, _shards, _contours)[style](rng, shape)
  art = art * (1 + 0.06 * textures.noise(rng, shape, slope=0.9))[..., None]
  border = int(0.05 * min(shape))
  framed = np.full((height, width, 3), 226.0)
  inner = np.s_[border:-border, border:-border]
  framed[inner] = art[inner]
  return textures.to_uint8(cv2.GaussianBlur(framed, (0, 0), 0.7))


def _hills(rng, shape):
  height, width = shape
  y = np.linspace(0, 1, height)[:, None]
  sky = rng.uniform([190, 120, 80], [250, 200, 160]) * y[..., None]
  picture = sky + rng.uniform([60, 90, 140], [120, 160, 210]) * (1 - y)[..., None]
  picture = np.broadcast_to(picture, (height, width, 3)).copy()
  sun = (int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.15, 0.35) * height))
  cv2.circle(picture, sun, int(0.1 * width), (250, 224, 150), -1, cv2.LINE_AA)
  rows = np.arange(height)[:, None]
  for k in range(7):
    ridge = textures.noise(rng, (8, width), slope=1.5)[0]
    ridge = height * (0.38 + 0.09 * k + 0.05 * ridge)
    shade = rng.uniform([30, 60, 50], [110, 130, 110]) * (1.25 - 0.12 * k)
    relief = 1 + 0.16 * textures.noise(rng, shape, slope=1.2, stretch=(1, 2))
    picture = np.where((rows > ridge)[..., None], shade * relief[..., None], picture)
  return picture


def _circles(rng, shape):
  height, width = shape
  picture = np.tile(rng.uniform([200, 190, 170], [236, 226, 210]), (height, width, 1))
  for _ in range(46):
    centre = rng.uniform(0, [width, height])
    radius = width * rng.uniform(0.02, 0.17)
    colour = _INKS[rng.integers(len(_INKS))] * rng.uniform(0.8, 1.2)
    place = (int(centre[0]), int(centre[1]))
    thickness = int(rng.choice([-1, 3, 6]))
    cv2.circle(picture, place, int(radius), colour, thickness, cv2.LINE_AA)
  return picture


def _shards(rng, shape):
  height, width = shape
  seeds = rng.uniform(0, [width, height], (90, 2))
  subdivision = cv2.Subdiv2D((-width, -height, 3 * width, 3 * height))
  subdivision.insert(seeds.astype(np.float32))
  picture = np.zeros((height, width, 3))
  low, high = rng.uniform([20, 40, 70], [60, 90, 130]), rng.uniform([210, 130, 80], [245, 205, 150])
  for cell, _ in zip(*subdivision.getVoronoiFacetList([]), strict=True):
    colour = low + (high - low) * rng.uniform(0, 1) + rng.normal(0, 12, 3)
    cv2.fillConvexPoly(picture, np.rint(cell).astype(np.int32), colour, cv2.LINE_AA)
  return picture


def _contours(rng, shape):
  field = textures.noise(rng, shape, slope=2.2)
  line = np.abs((field * 5) % 1 - 0.5) * 2
  line = np.clip((line - 0.72) * 6, 0, 1)[..., None]
  ground = textures.tinted(1.4 * field, (38, 70, 96), (224, 200, 150))
  return ground * (1 - line) + np.array([40, 36, 40]) * line


def spines(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  """Returns SPINES book spines side by side, each with bands and lettering, uint8 [H, W, 3]."""
  height, width = shape
  sheet = np.zeros((height, width, 3))
  edges = np.linspace(0, width, SPINES + 1).astype(int)
  for left, right in itertools.pairwise(edges):
    ground = _CLOTHS[rng.integers(len(_CLOTHS))] * rng.uniform(0.8, 1.15)
    ink = ground + np.where(ground.mean() > 110, -90, 100)
    book = np.tile(ground, (height, right - left, 1))
    for _ in range(int(rng.integers(1, 5))):
      top = int(rng.uniform(0.03, 0.92) * height)
      book[top : top + int(rng.uniform(0.01, 0.07) * height)] = _CLOTHS[rng.integers(len(_CLOTHS))]
    letter = rng.uniform(0.12, 0.3) * height
    while letter < 0.85 * height:  # title, letter by letter along the spine
      length = rng.uniform(0.008, 0.03) * height
      a = int(rng.uniform(0.25, 0.4) * (right - left))
      b = int(rng.uniform(0.6, 0.78) * (right - left))
      if rng.random() < 0.8:
        book[int(letter) : int(letter + length), a:b] = ink
      letter += length + 0.012 * height
    book *= (1 - 0.4 * np.abs(np.linspace(-1, 1, right - left)) ** 3)[None, :, None]
    sheet[:, left:right] = book
  sheet *= (1 + 0.06 * textures.noise(rng, shape, slope=1.0))[..., None]
  return textures.to_uint8(cv2.GaussianBlur(sheet, (0, 0), 0.8))


def window_view(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  """Returns a garden behind the panes of a window, with its white bars, uint8 [H, W, 3]."""
  height, width = shape
  y = np.linspace(0, 1, height)[:, None]
  clouds = textures.noise(rng, shape, slope=1.7)
  picture = textures.tinted(clouds, (150, 186, 222), (244, 246, 248))
  for k in range(5):
    edge = 0.42 + 0.11 * k + 0.05 * textures.noise(rng, (8, width), slope=1.2)[0]
    foliage = textures.noise(rng, shape, slope=1.0)
    shade = textures.tinted(foliage, (62, 98, 52), (156, 182, 110)) * (1.15 - 0.11 * k)
    picture = np.where((y > edge)[..., None], shade, picture)
  bar = int(0.03 * width)
  for x in (0, (width - bar) // 2, width - bar):
    picture[:, x : x + bar] = 232
  for top in (0, int(0.62 * height), height - bar):
    picture[top : top + bar] = 232
  return textures.to_uint8(picture)


def door(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  """Returns a panelled door with its handle, uint8 [H, W, 3]."""
  height, width = shape
  tall = textures.wood(rng, (width, height), dark=(96, 108, 104), light=(150, 160, 150))
  picture = np.ascontiguousarray(tall.transpose(1, 0, 2))
  for top, bottom in ((0.06, 0.3), (0.36, 0.6), (0.66, 0.94)):
    for left, right in ((0.12, 0.46), (0.54, 0.88)):
      a, b = (int(left * width), int(top * height)), (int(right * width), int(bottom * height))
      cv2.rectangle(picture, a, b, (70, 80, 76), 5)
      cv2.rectangle(picture, (a[0] + 6, a[1] + 6), b, (178, 186, 176), 3)
  place = (int(0.9 * width), int(0.55 * height))
  cv2.circle(picture, place, int(0.035 * width), (196, 170, 96), -1, cv2.LINE_AA)
  return textures.to_uint8(picture)
