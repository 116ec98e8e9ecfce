"""Simulates the path of a hand-held phone through the built-in room.

Four rounds: along the furniture at eye height looking across the room, near the middle looking
outwards, and the same two at the height of a small robot. Between rounds the phone moves straight
across the room, looking ahead. All rounds see the same walls, so that loops can be closed.
Frames: world z up; camera axes of OpenCV.
"""

import dataclasses

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from nerf2real.core.geometry.rotations import camera_axes

RATE = 120.0  # samples of a path a second
_SMOOTHING = 0.5  # standard deviation of the filter that rounds off the rounds' joints [s]
_CENTRE = np.array([0.32, -0.17])  # of the open floor [m]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Round:
  """One closed round: an ellipse about the middle of the open floor."""

  share: float
  """Of the film's time."""
  radii: tuple[float, float]
  """Along x and y [m]."""
  heights: tuple[float, float]
  """At its beginning and end [m]."""
  start: float
  """Angle on the ellipse at the beginning [rad]."""
  turns: float
  """Rounds; negative is clockwise."""
  outwards: bool
  """Look away from the middle, else across the room."""
  sway: float
  """Amplitude of looking left and right [rad]."""
  pitch: float
  """Mean inclination; positive looks down [rad]."""
  nod: float
  """Amplitude of looking up and down [rad]."""


ROUNDS = (
  Round(
    share=0.25,
    radii=(1.3, 1.2),
    heights=(1.55, 1.45),
    start=-2.2,
    turns=1.0,
    outwards=False,
    sway=0.45,
    pitch=0.38,
    nod=0.17,
  ),
  Round(
    share=0.20,
    radii=(0.55, 0.5),
    heights=(1.35, 0.9),
    start=-2.2 + np.pi,
    turns=-1.0,
    outwards=True,
    sway=0.12,
    pitch=0.34,
    nod=0.2,
  ),
  Round(
    share=0.25,
    radii=(1.3, 1.2),
    heights=(0.5, 0.44),
    start=-2.2,
    turns=1.0,
    outwards=False,
    sway=0.45,
    pitch=0.2,
    nod=0.14,
  ),
  Round(
    share=0.20,
    radii=(0.6, 0.55),
    heights=(0.44, 0.55),
    start=-2.2 + np.pi,
    turns=-1.0,
    outwards=True,
    sway=0.12,
    pitch=0.22,
    nod=0.16,
  ),
)


def _round_samples(part: Round, count: int) -> np.ndarray:
  """Position (3), heading and pitch along one round, [T, 5]."""
  s = np.linspace(0, 1, count)
  angle = part.start + 2 * np.pi * part.turns * s
  flat = _CENTRE + np.stack([np.cos(angle), np.sin(angle)], -1) * part.radii
  height = part.heights[0] + (part.heights[1] - part.heights[0]) * s
  heading = angle + (0.0 if part.outwards else np.pi)
  heading = heading + part.sway * np.sin(2 * np.pi * 2 * s)
  pitch = part.pitch + part.nod * np.sin(2 * np.pi * 3 * s)
  return np.column_stack([flat, height, heading, pitch])


def _path_samples(seconds: float) -> np.ndarray:
  """The rounds, joined by straight walks across the room, [T, 5] at RATE."""
  rounds = [_round_samples(r, max(int(r.share * seconds * RATE), 2)) for r in ROUNDS]
  crossing = (1 - sum(r.share for r in ROUNDS)) / (len(ROUNDS) - 1)
  s = np.linspace(0, 1, max(int(crossing * seconds * RATE), 2))[1:-1, None]
  parts = [rounds[0]]
  for part in rounds[1:]:
    last, first = parts[-1][-1], part[0]
    turn = 2 * np.pi * np.round((last[3] - first[3]) / (2 * np.pi))
    part = part + np.array([0, 0, 0, turn, 0])
    parts += [last + (3 - 2 * s) * s * s * (part[0] - last), part]
  return np.concatenate(parts)


def _shake(rng: np.random.Generator, times: np.ndarray, low: float, high: float) -> np.ndarray:
  """A sum of eight sines of 1/f amplitude, [T], standard deviation 1."""
  frequencies = np.exp(rng.uniform(np.log(low), np.log(high), 8))
  amplitude = 1 / frequencies
  amplitude *= np.sqrt(2 / (amplitude**2).sum())
  phase = rng.uniform(0, 2 * np.pi, 8)
  return (amplitude * np.sin(2 * np.pi * frequencies * times[:, None] + phase)).sum(-1)


class HandHeld:
  """A smooth path: `pose(times)` gives the camera at any time."""

  def __init__(
    self,
    samples: np.ndarray,
    rng: np.random.Generator,
    *,
    seconds: float,
    shake_position=0.006,
    shake_angle=0.007,
  ):
    """Lays out the path.

    Args:
      samples: Position (3) [m], heading and pitch [rad], RATE a second [T, 5].
      rng: Of the shake.
      seconds: Length of the film [s].
      shake_position: Standard deviation of the hand's shake along each axis [m].
      shake_angle: Standard deviation of the hand's shake about each axis [rad].
    """
    sigma = min(_SMOOTHING, 0.05 * seconds) * RATE
    samples = gaussian_filter1d(samples, sigma, axis=0, mode="nearest")
    position, (heading, pitch) = samples[:, :3], samples[:, 3:].T
    times = np.linspace(0, seconds, len(samples))
    position[:, 2] += 0.008 * np.sin(2 * np.pi * 1.7 * times)  # steps
    for axis in range(3):
      position[:, axis] += shake_position * _shake(rng, times, 0.4, 4.0)
    level = np.cos(pitch)
    forward = np.stack([level * np.cos(heading), level * np.sin(heading), -np.sin(pitch)], -1)
    right, down, _ = np.moveaxis(camera_axes(forward), -1, 0)
    angle = shake_angle * np.stack([_shake(rng, times, 0.4, 5.0) for _ in range(3)], -1)
    forward = forward + angle[:, :1] * right + angle[:, 1:2] * down
    right = right + angle[:, 2:] * down
    self._position = CubicSpline(times, position)
    self._forward = CubicSpline(times, forward)
    self._right = CubicSpline(times, right)

  def pose(self, times: np.ndarray) -> np.ndarray:
    """Returns world_from_camera [T, 4, 4] at times [T] [s]."""
    times = np.asarray(times, np.float64)
    forward = self._forward(times)
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = self._right(times)
    right -= (right * forward).sum(-1, keepdims=True) * forward
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    pose = np.tile(np.eye(4), (len(times), 1, 1))
    pose[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    pose[:, :3, 3] = self._position(times)
    return pose


class Walk(HandHeld):
  """The path through the built-in room."""

  def __init__(self, seed: int, *, seconds: float, shake_position=0.006, shake_angle=0.007):
    """Lays out the path; the seed is the shake's, the rest as in `HandHeld`."""
    super().__init__(
      _path_samples(seconds),
      np.random.default_rng([seed, 4]),
      seconds=seconds,
      shake_position=shake_position,
      shake_angle=shake_angle,
    )
