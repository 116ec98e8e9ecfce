"""Films a drawn room as a person with a phone does: by hand, with automatic exposure."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from skimage import graph

from benchmarks.drawn_rooms import looks
from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.builtin import camera_path, filming, room
from nerf2real.scenes.builtin.mujoco_renderer import Eye
from nerf2real.scenes.builtin.room import TrueRoom
from nerf2real.scenes.poses.mapping import camera_fault

Random = np.random.Generator

_SECONDS, _RATE = 60.0, 12.0
_GREY = 118.0  # level that automatic exposure holds the mean at
_FOLLOWS = 0.06  # share by which it follows a picture
_GAINS = (0.6, 1.7)  # that it may take
CORNERS = (0.6, 0.95)  # share of the light that a lens leaves in a picture's corners
_CELL = 0.05  # m of the grid in which the walk keeps clear of things
_CLEAR = 0.35  # m
_AVOIDS = 60.0  # times the way that a place costs which is not clear
_STOPS = 24  # of a round


@dataclasses.dataclass(frozen=True, kw_only=True)
class Round:
  """One closed round through the room."""

  height: float
  """m."""
  reach: float
  """Share of the way from the middle to the walls."""
  outwards: bool
  pitch: float
  """Downwards [rad]."""
  turns: float
  start: float
  sway: float


def rounds(random: Random) -> list[Round]:
  """Returns rounds at a person's eyes and at a robot's, looking across the room and outwards."""
  found = []
  for height, reach, outwards, pitch in (
    (random.uniform(1.35, 1.65), 0.75, False, 0.4),
    (random.uniform(1.1, 1.5), 0.35, True, 0.4),
    (random.uniform(0.45, 0.7), 0.75, False, 0.12),
    (random.uniform(0.4, 0.6), 0.4, True, 0.2),
  ):
    found.append(
      Round(
        height=height,
        reach=reach + random.uniform(-0.08, 0.08),
        outwards=outwards,
        pitch=pitch + random.uniform(-0.06, 0.06),
        turns=random.choice((-1.0, 1.0)) * random.uniform(1.0, 1.2),
        start=random.uniform(0, 2 * np.pi),
        sway=random.uniform(0.15, 0.45),
      )
    )
  return found


class _Clear:
  """Ways at a height on which a hand does not meet things."""

  def __init__(self, true_room: TrueRoom, height: float):
    self._low = -np.array(true_room.size[:2]) / 2
    u, v = (np.arange(_CELL / 2, s, _CELL) - s / 2 for s in true_room.size[:2])
    grid = np.stack(np.meshgrid(u, v, indexing="ij"), -1)
    points = np.concatenate([grid, np.full((*grid.shape[:2], 1), height)], -1).reshape(-1, 3)
    gap = true_room.distance(points, limit=1.0).reshape(grid.shape[:2])
    self._cost = np.where(gap > _CLEAR, 1.0, 1.0 + _AVOIDS * np.clip(1 - gap / _CLEAR, 0, 2) ** 2)
    self._cells = np.argwhere(gap > _CLEAR)

  def route(self, places: np.ndarray, count: int) -> np.ndarray:
    """Returns a way along places [P, 2], each moved to the nearest clear one, even [count, 2]."""
    wanted = (places - self._low) / _CELL - 0.5
    gaps = np.linalg.norm(wanted[:, None] - self._cells[None], axis=-1)
    stops = self._cells[gaps.argmin(axis=1)]
    way = [stops[0]]
    for here, there in itertools.pairwise(stops):
      way += graph.route_through_array(self._cost, here, there, geometric=True)[0][1:]
    line = self._low + (np.array(way) + 0.5) * _CELL
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1))]
    even = np.linspace(0, along[-1], count)
    return np.stack([np.interp(even, along, line[:, k]) for k in range(2)], -1)


def walk(true_room: TrueRoom, walked: Sequence[Round], *, seconds: float = _SECONDS) -> np.ndarray:
  """Returns a path's position (3) [m], heading and pitch [rad], `camera_path.RATE` a second [T, 5].

  Rounds with ways between; where one would lead through things it goes along them.
  """
  crossing = 0.05
  count = int((1 - crossing * (len(walked) - 1)) / len(walked) * seconds * camera_path.RATE)
  parts: list[np.ndarray] = []
  s = np.linspace(0, 1, count)
  for part in walked:
    angle = part.start + 2 * np.pi * part.turns * s
    stops = angle[:: count // _STOPS]
    ring = np.stack([np.cos(stops), np.sin(stops)], -1) * part.reach * 0.5
    clear = _Clear(true_room, part.height)
    flat = clear.route(ring * true_room.size[:2], count)
    heading = angle + (0.0 if part.outwards else np.pi) + part.sway * np.sin(4 * np.pi * s)
    pitch = part.pitch + 0.15 * np.sin(6 * np.pi * s)
    new = np.column_stack([flat, np.full(count, part.height), heading, pitch])
    if parts:
      last = parts[-1][-1]
      new[:, 3] += 2 * np.pi * np.round((last[3] - new[0, 3]) / (2 * np.pi))
      t = np.linspace(0, 1, int(crossing * seconds * camera_path.RATE))[:, None]
      between = last + (3 - 2 * t) * t * t * (new[0] - last)
      between[:, :2] = clear.route(np.stack([last[:2], new[0, :2]]), len(t))
      parts.append(between)
    parts.append(new)
  return np.concatenate(parts)


def lens(random: Random) -> Camera:
  """Returns a phone's camera for films of 640x480."""
  focal = random.uniform(430.0, 620.0)
  drawn = Camera(
    width=640,
    height=480,
    fx=focal,
    fy=focal * random.uniform(0.997, 1.003),
    cx=320 + random.uniform(-6, 6),
    cy=240 + random.uniform(-6, 6),
  )
  while True:
    k1, k2 = random.uniform(-0.06, 0.1), random.uniform(-0.12, 0.02)
    camera = dataclasses.replace(drawn, k1=k1, k2=k2)
    if camera_fault(camera) is None:  # one of a hundred folds its corners
      return camera


def lights(random: Random) -> tuple[list[tuple[tuple[float, ...], tuple[float, ...]]], float]:
  """Returns lights (direction of travel, colour), and the light from everywhere."""
  warmth = random.uniform(0.85, 1.05)
  found = []
  for share in (0.40, 0.22, 0.16, 0.16, 0.14):
    away = random.standard_normal(3)
    away[2] = -abs(away[2]) * 0.7
    colour = share * random.uniform(0.8, 1.2) * np.array([1.0, 0.5 + 0.5 * warmth, warmth])
    found.append((tuple(away / np.linalg.norm(away)), tuple(colour)))
  found.append(((0.0, 0.05, 1.0), (0.16, 0.155, 0.15)))
  return found, float(random.uniform(0.42, 0.55))


def seen(true_room: TrueRoom, seed: int) -> Eye:
  """Returns a renderer of a drawn room; close it after use."""
  painted = looks.paint(true_room.solids, np.random.default_rng([seed, 2]))
  shining, ambient = lights(np.random.default_rng([seed, 3]))
  spec = room.assemble(true_room.solids, painted, lights=shining, ambient=ambient)
  return Eye(spec.compile())


def film(path: Path, true_room: TrueRoom, eye: Eye, seed: int) -> tuple[np.ndarray, float]:
  """Writes a film.

  Returns:
    The poses of its pictures, world_from_camera [T, 4, 4], and pictures a second.
  """
  random = np.random.default_rng([seed, 4])
  settings = filming.FilmSettings(
    camera=lens(random), seconds=_SECONDS, frame_rate=_RATE, subframes=2, speed="veryfast"
  )
  taken = camera_path.HandHeld(walk(true_room, rounds(random)), random, seconds=_SECONDS)
  times = (np.arange(settings.frames) + 0.5) / _RATE
  filming.encode(path, _exposed(eye, taken, times, settings, random), settings)
  return taken.pose(times), _RATE


def light(camera: Camera, corners: float) -> np.ndarray:
  """Returns what a lens leaves of the light [H, W, 1], so much in the corners."""
  v, u = np.mgrid[: camera.height, : camera.width]
  radius = np.hypot(u - camera.cx, v - camera.cy) / np.hypot(camera.width, camera.height) * 2
  return 1 - (1 - corners) * radius[..., None] ** 2


def metered(picture: np.ndarray) -> float:
  """Returns the gain that automatic exposure wants for a picture [H, W, 3]."""
  return float(np.clip(_GREY / picture.mean(), *_GAINS))


def _exposed(
  eye: Eye,
  taken: camera_path.HandHeld,
  times: np.ndarray,
  settings: filming.FilmSettings,
  random: Random,
) -> Iterator[np.ndarray]:
  """Yields pictures whose gain follows their mean, darker towards the corners."""
  camera = settings.camera
  falloff = light(camera, random.uniform(*CORNERS))
  gain = 0.0
  for when in times:
    picture = filming.exposed(eye, taken, when, settings) * falloff
    wanted = metered(picture)
    gain = gain + _FOLLOWS * (wanted - gain) if gain else wanted
    yield filming.with_noise(gain * picture, settings, random)
