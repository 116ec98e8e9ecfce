"""The camera's gain: how bright pictures are beside those of reference logs from the same place.

Nothing but earlier pictures says how bright a place should be. A picture is compared with the
reference picture of the nearest orientation, turned into its view through the lens; pixels near
black or white are left out, and pictures that do not show the same thing (by correlation) too.

Shapes: H height, W width, M pictures.
"""

import dataclasses
from collections.abc import Sequence

import cv2
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.sensors import optical, pictures, sensed, viewpoint
from nerf2real.sysid.sensors.sensed import Part, row
from nerf2real.sysid.sensors.viewpoint import View
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

_WIDTH = 80  # pixel of the pictures that are compared: what latency and distance shift is less
_MOST = 120  # pictures of a log
_FEWEST = 10  # pairs that show the same thing
_SLOW = 1.5  # rad/s: faster pictures are smeared
_NEAR = (0.25, 0.15)  # rad, m between two pictures' cameras
_ALIKE = 0.7  # correlation of two pictures of the same thing
_BLACK, _WHITE = 12.0, 240.0  # levels beyond which a pixel is clipped or noise
_FEWEST_PIXELS = 200
_OUTSIDE = -1e4  # level of pixels that a picture does not show
_SHIFT = 5.0  # pixel by which poses may be wrong
_USUAL = 0.1  # of the logarithm: lamps and daylight; ours
_FLOOR = 0.02  # of the logarithm: no two pictures are closer


@dataclasses.dataclass(frozen=True)
class _Small:
  """Small pictures of one log."""

  time: Array
  """[M] s."""
  look: Array
  """[M, H, W] levels."""
  turn: Rotation
  place: Array
  """[M, 3] m."""
  lens: Camera


def find(model: mujoco.MjModel, seen: optical.Seen, reference: Sequence[Log]) -> Part:
  """Returns the camera's gain.

  Args:
    model: the declared one.
    seen: pictures and poses of the logs, by `optical.find`.
    reference: logs of the same apparatus at the same place.
  """
  filmed = optical.with_pictures(reference)
  if not filmed or not seen.sources:
    return Part()
  try:
    known = [_small(s, v, seen.delay) for s, v in zip(*optical.look(model, filmed), strict=True)]
  except pictures.LensError as error:
    return Part(notes=[str(error)])
  levels, blocks = [], []
  for number, (source, view) in enumerate(zip(seen.sources, seen.views, strict=True)):
    small = _small(source, view, seen.delay)
    for n in range(len(small.time)):
      ratio = _compared(small, n, known, seen.scale)
      if ratio is not None:
        levels.append(ratio)
        blocks.append(1_000_000 * number + int(small.time[n] / SETTINGS.block_s))
  if len(levels) < _FEWEST:
    note = (
      "The reference logs' pictures do not show what the logs' show: the camera's gain is unknown."
    )
    return Part(notes=[note])
  camera = viewpoint.choose(model, seen.sources[0].frame)
  name = model.camera(camera).name
  return _judge(np.array(levels), np.unique(blocks, return_inverse=True)[1], name)


def _judge(levels: Array, block: Array, camera: str) -> Part:
  """Returns what logarithms of ratios [M] in blocks [M] say."""
  means = np.array([levels[block == b].mean() for b in range(block.max() + 1)])
  value = float(np.median(means)) if len(means) > 2 else float(means.mean())
  half = sensed.SIGMAS * max(float(means.std()), _FLOOR) / np.sqrt(max(len(means) - 1, 1))
  odd = np.arange(len(means)) % 2 == 1
  left = means - np.where(odd, means[~odd].mean(), means[odd].mean() if odd.any() else value)
  before, after = (float(np.sqrt(np.mean(e**2) + _FLOOR**2)) for e in (means, left))
  part = Part(before=before, after=before)
  gain = float(np.log(before / after))
  if gain > sensed.GAIN and (value - half > _USUAL or value + half < -_USUAL):
    values = {
      "gain": (float(np.exp(value)), float(np.exp(value - half)), float(np.exp(value + half)))
    }
    part.rows.append(row("camera_gain", camera, values, gain, gain))
    part.after = after
  return part


def _small(source: pictures.Source, view: View, delay: float) -> _Small:
  """Returns the pictures that were taken while the camera moved slowly, small."""
  height = round(_WIDTH * source.lens.height / source.lens.width)
  lens = source.lens.resized(_WIDTH, height)
  times, looks = [], []
  for stamp, grey in pictures.read(source):
    taken = stamp - delay
    if not view.time[0] <= taken <= view.time[-1]:
      continue
    ends = view.rotation(np.array([taken - 0.02, taken + 0.02]))
    if (ends[0].inv() * ends[1]).magnitude() < 0.04 * _SLOW:
      times.append(taken)
      looks.append(cv2.resize(grey, (_WIDTH, height), interpolation=cv2.INTER_AREA))
  every = max(1, -(-len(times) // _MOST))
  time = np.array(times[::every])
  look = np.array(looks[::every]).reshape(-1, height, _WIDTH).astype(np.float32)
  turn = view.rotation(time) if len(time) else view.turn[:0]
  return _Small(time, look, turn, view.position(time), lens)


def _compared(small: _Small, n: int, known: Sequence[_Small], scale: float) -> float | None:
  """Returns the logarithm of a picture's brightness over the reference's; None without one."""
  best, chosen = _NEAR[0], None
  for other in known:
    if not len(other.time):
      continue
    angle = (small.turn[n].inv() * other.turn).magnitude()
    angle = np.where(np.linalg.norm(other.place - small.place[n], axis=1) < _NEAR[1], angle, np.inf)
    nearest = int(np.argmin(angle))
    if angle[nearest] < best:
      best, chosen = float(angle[nearest]), (other, nearest)
  if chosen is None:
    return None
  other, m = chosen
  turn = (other.turn[m].inv() * small.turn[n]).as_matrix()
  # The reference may have been filmed through the same lens as the log, or the declared one.
  pairs = {(scale, 1.0), (scale, scale)}
  ratios = [
    _ratio(
      small.look[n], _longer(small.lens, here), other.look[m], _longer(other.lens, there), turn
    )
    for here, there in pairs
  ]
  return max(ratios, key=lambda found: found[0])[1]


def _longer(lens: Camera, scale: float) -> Camera:
  return dataclasses.replace(lens, fx=lens.fx * scale, fy=lens.fy * scale)


def _ratio(
  found: Array, lens: Camera, known: Array, other: Camera, turn: Array
) -> tuple[float, float | None]:
  """Returns the correlation of two pictures, and the logarithm of their ratio if they are alike.

  Args:
    found: picture [H, W].
    lens: its own.
    known: reference picture [H, W].
    other: its lens.
    turn: the reference's camera from the picture's [3, 3].
  """
  across = lens.rays() @ turn.T
  ahead = across[..., 2] > 0.1
  across[~ahead] = (0.0, 0.0, 1.0)
  at = (other.project(across) - 0.5).astype(np.float32)
  at += _shift(_turned(known, at), found)  # latency, mount, distance
  expected = _turned(known, at)
  good = ahead & (expected > _BLACK) & (expected < _WHITE) & (found > _BLACK) & (found < _WHITE)
  if good.sum() < _FEWEST_PIXELS:
    return -1.0, None
  a, b = expected[good].astype(float), found[good].astype(float)
  if a.std() < 1.0 or b.std() < 1.0:
    return -1.0, None
  alike = float(np.corrcoef(a, b)[0, 1])
  return alike, float(np.log(np.median(b / a))) if alike > _ALIKE else None


def _turned(look: Array, at: Array) -> Array:
  """Returns a picture seen from elsewhere [H, W]: at pixels [H, W, 2]; far below 0 outside."""
  return cv2.remap(
    look,
    at[..., 0],
    at[..., 1],
    cv2.INTER_LINEAR,
    borderMode=cv2.BORDER_CONSTANT,
    borderValue=_OUTSIDE,
  )


def _shift(expected: Array, found: Array) -> Array:
  """Returns by how many pixels [2] to sample further for one picture to lie on another."""
  known = expected > 0
  if not known.any():
    return np.zeros(2, np.float32)
  filled = [np.where(known, look - look[known].mean(), 0.0) for look in (expected, found)]
  filled = [np.asarray(look / max(float(look.std()), 1e-3), np.float32) for look in filled]
  window = cv2.createHanningWindow(expected.shape[::-1], cv2.CV_32F)
  shift, _ = cv2.phaseCorrelate(filled[0], filled[1], window)
  far = np.abs(shift).max() > _SHIFT
  return np.zeros(2, np.float32) if far else -np.array(shift, np.float32)
