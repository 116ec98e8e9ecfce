"""Judges a capture before an hour is spent on it: what is good, what to film again, and where.

Shapes: N keyframes with a pose.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from nerf2real.core import files, palette
from nerf2real.core.floor_map import Floor, FloorMap
from nerf2real.core.picture_files import write_picture
from nerf2real.scenes.alignment.world_frame import Alignment
from nerf2real.scenes.capture.capture import Capture, CaptureSettings, quality_warnings
from nerf2real.scenes.poses.film import continuity
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.poses.tracks import Tracks
from nerf2real.scenes.quality.coverage import Coverage, coverage

_FLOOR_SHARE = 0.7  # of the floor that must be covered; chosen: a robot walks on the rest of it
_WALL_SHARE = 0.6  # of the walls; chosen: cupboards and doors may hide the others
_REGISTERED = 0.9  # share of the keyframes that must have a pose
_LOOP_POINTS = (
  30  # points that the first and the last tenth of a film share when its loop is closed
)
_MAP_HEIGHT = 480  # of the picture [pixel]
_CLOCK = 12
_GAP, _SEEN = palette.rgb(palette.VERMILION), palette.rgb(palette.BLUE)
_COVERED = (190, 215, 200)
_LEGEND_ROW = 22  # height of a line [pixel]
_LEGEND = (
  (_GAP, "fewer than three pictures show it: film it again"),
  (_COVERED, "shown well enough"),
  (_SEEN, "your walk; the disc is its start, its nose is 12 o'clock"),
)


class Finding(NamedTuple):
  """One thing that was judged."""

  name: str
  good: bool
  text: str  # a sentence: what was found, and where it is not good what to do


@dataclasses.dataclass(frozen=True)
class Verdict:
  """What a capture is worth."""

  findings: Sequence[Finding]
  picture: np.ndarray | None = None  # RGB [H, W, 3]: the room from above, what to film again marked
  notes: Sequence[str] = ()  # what was left out or assumed, as the scene's report will say

  @property
  def good(self) -> bool:
    """Whether everything that was judged is good."""
    return all(finding.good for finding in self.findings)

  @property
  def words(self) -> str:
    """A line for the whole and one for each finding, what is wrong first, and for each note."""
    head = "Good to go:" if self.good else "Film again before you spend an hour on it:"
    ordered = sorted(self.findings, key=lambda finding: finding.good)
    lines = (f"- {'good' if finding.good else 'bad'}: {finding.text}" for finding in ordered)
    return "\n".join([head, *lines, *(f"- note: {note}" for note in self.notes)])

  def save_picture(self, path: Path) -> None:
    """Writes the picture as PNG."""
    assert self.picture is not None
    with files.atomic_path(path) as partial:
      write_picture(partial, self.picture[..., ::-1])


def _spans(times: np.ndarray, chosen: np.ndarray) -> str:
  """The longest runs of chosen keyframes as times in a film: "0:12 to 0:15"."""
  edges = np.flatnonzero(np.diff(np.r_[0, chosen.astype(int), 0]))
  runs = sorted(edges.reshape(-1, 2).tolist(), key=lambda run: run[0] - run[1])[:3]
  words = []
  for first, last in sorted(runs):
    ends = [f"{int(times[k]) // 60}:{int(times[k]) % 60:02d}" for k in (first, last - 1)]
    words.append(ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}")
  return ", ".join(words)


def _where(capture: Capture, chosen: np.ndarray) -> str:
  """Which keyframes, by their time in the film or their names."""
  if capture.times is not None:
    return f"at {_spans(capture.times, chosen)}"
  return f"as {capture.called(chosen, most=3)}"


def judge_pictures(capture: Capture, settings: CaptureSettings) -> list[Finding]:
  """Judges blur and exposure of the keyframes."""
  found = []
  blurred = capture.blur > settings.warn_blur
  share, good = float(blurred.mean()), float(blurred.mean()) <= settings.warn_blurred_fraction
  text = f"{share:.0%} of the pictures lose half of the robot's finest detail: they are blurred"
  if not good:
    text += f", {_where(capture, blurred)}: walk and turn slower there, or switch the light on"
  found.append(Finding("blur", good, text + "."))
  low, high = np.percentile(capture.brightness, [5, 95])
  ratio = float(high / max(low, 1.0))
  good = ratio <= settings.warn_brightness_range
  text = f"Their mean brightness differs by a factor of {ratio:.1f}"
  if not good:
    text += ": hold the phone's exposure fixed (press long on the screen)"
  found.append(Finding("exposure", good, text + "."))
  return found


def _shared_points(tracks: Tracks, count: int) -> int | None:
  """Points that the first and the last tenth of N pictures see; None without observations."""
  if not len(tracks.view):
    return None
  tenth = max(1, count // 10)
  first, last = (tracks.point[rows] for rows in (tracks.view < tenth, tracks.view >= count - tenth))
  return len(np.intersect1d(first, last))


def judge_poses(capture: Capture, poses: Localisation) -> list[Finding]:
  """Judges how many keyframes have a pose, and whether a film is whole and comes back to where it
  began."""
  placed = np.isin([path.name for path in capture.images], poses.names)
  good = float(placed.mean()) >= _REGISTERED
  text = f"{placed.sum()} of {len(placed)} pictures have a place"
  if not good:
    text += (
      f"; none {_where(capture, ~placed)}: film that stretch again, slower, without plain walls"
    )
  found = [Finding("poses", good, text + ".")]
  if capture.times is not None and poses.left_out:
    times = {path.name: when for path, when in zip(capture.images, capture.times, strict=True)}
    found.append(Finding("line", False, continuity.gaps(poses.left_out, poses.names, times)))
  shared = _shared_points(poses.tracks, len(poses.names))
  if capture.kind == "video" and shared is not None:
    closed = shared >= _LOOP_POINTS
    text = f"Beginning and end share {shared} points, so the loop is closed."
    if not closed:
      text = (
        f"Beginning and end share only {shared} points, so the loop is open: end by filming what "
        "you began with, from the same place."
      )
    found.append(Finding("loop", closed, text))
  return found


def _direction(gaps: np.ndarray, poses: np.ndarray) -> str:
  """Where most gaps lie, as on a clock: 12 is where the first picture looks."""
  forward = poses[0, :2, 2]
  offset = gaps[:, :2] - np.median(poses[:, :2, 3], axis=0)
  angle = np.arctan2(forward[1], forward[0]) - np.arctan2(offset[:, 1], offset[:, 0])
  hours = np.round(angle / (2 * np.pi) * _CLOCK).astype(int) % _CLOCK
  counts = np.bincount(hours, minlength=_CLOCK)
  worst = [int(hour) or _CLOCK for hour in np.argsort(-counts)[:3] if counts[hour] > 0]
  return ", ".join(f"{hour} o'clock" for hour in sorted(worst))


def judge_coverage(found: Coverage, poses: np.ndarray) -> list[Finding]:
  """Judges which share of floor and walls the pictures show, poses [N, 4, 4] in the world."""
  findings = []
  for name, share, wanted, places, covered, advice in (
    (
      "floor",
      found.shares[0],
      _FLOOR_SHARE,
      found.floor,
      found.floor_covered,
      "tilt the phone down",
    ),
    ("walls", found.shares[1], _WALL_SHARE, found.walls, found.walls_covered, "pan slowly"),
  ):
    good = share >= wanted
    text = f"Three pictures or more show {share:.0%} of the {name}"
    if not good:
      text += (
        f"; film towards {_direction(places[~covered], poses)} ({advice}), where 12 o'clock is the "
        "direction of the first picture seen from the middle of your walk"
      )
    findings.append(Finding(name, good, text + "."))
  return findings


def _clock(poses: np.ndarray, hours: np.ndarray) -> np.ndarray:
  """Directions [N, 2] of hours [N] from the middle of the walk: 12 is where the first one looks."""
  forward = np.arctan2(poses[0, 1, 2], poses[0, 0, 2])
  angle = forward - 2 * np.pi * hours / _CLOCK
  return np.stack([np.cos(angle), np.sin(angle)], -1)


def _with_legend(picture: np.ndarray) -> np.ndarray:
  """Adds what the colours stand for below a picture [H, W, 3]."""
  strip = np.full((_LEGEND_ROW * len(_LEGEND), picture.shape[1], 3), 255, np.uint8)
  for row, (color, words) in enumerate(_LEGEND):
    top = row * _LEGEND_ROW
    cv2.rectangle(strip, (8, top + 5), (22, top + _LEGEND_ROW - 5), color, -1)
    place = (30, top + _LEGEND_ROW - 7)
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(strip, words, place, font, 0.4, palette.rgb(palette.INK), 1, cv2.LINE_AA)
  return np.concatenate([picture, strip])


def draw(found: Coverage, poses: np.ndarray, extent: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
  """Draws the room from above: covered floor light, gaps marked, the walk, hours as on a clock."""
  lower, upper = (
    np.asarray(corner, np.float64)[:2] - s for corner, s in zip(extent, (0.3, -0.3), strict=True)
  )
  blank = Floor(reachable=np.zeros((1, 1), bool), resolution=1.0, origin=lower)
  area = (float(lower[0]), float(upper[0]), float(lower[1]), float(upper[1]))
  picture = FloorMap.of(blank, height=_MAP_HEIGHT, extent=area)
  for places, covered, radius in (
    (found.floor, found.floor_covered, 0.05),
    (found.walls, found.walls_covered, 0.07),
  ):
    for place, seen in zip(places, covered, strict=True):
      picture.disc(place[:2], radius, _COVERED if seen else _GAP)
  picture.path(poses[:, :2, 3], _SEEN)
  start = poses[0, :2, 3]
  picture.robot(start, float(np.arctan2(poses[0, 1, 2], poses[0, 0, 2])), _SEEN)
  middle = np.median(poses[:, :2, 3], axis=0)
  reach = 0.85 * float(np.minimum(middle - lower, upper - middle).min())
  hours = np.arange(1, _CLOCK + 1)
  for hour, way in zip(hours, _clock(poses, hours), strict=True):
    picture.label(middle + reach * way, str(hour))
  return _with_legend(picture.scale_bar().picture)


def judge(
  capture: Capture,
  settings: CaptureSettings,
  *,
  poses: Localisation | None = None,
  frame: Alignment | None = None,
  reason: str = "",
) -> Verdict:
  """Judges a capture from its keyframes and, where they were found, its poses.

  Args:
    capture: The keyframes.
    settings: What counts as blurred and as changing exposure.
    poses: The localised keyframes; None where that failed.
    frame: Their world frame; None where none was found.
    reason: Why there are no poses, or no world frame.
  """
  findings = judge_pictures(capture, settings)
  judged = quality_warnings(capture, settings)
  notes = [text for text in capture.warnings if text not in judged]
  if poses is None:
    return Verdict([Finding("poses", False, reason), *findings], notes=notes)
  findings += judge_poses(capture, poses)
  notes += map(capture.told, poses.warnings)
  if frame is None:
    return Verdict([*findings, Finding("floor", False, reason)], notes=notes)
  notes += frame.warnings
  world = frame.world_from_unit.apply_pose(poses.world_from_camera)
  extent = frame.extent_lower, frame.extent_upper
  found = coverage(poses.camera, world, extent)
  findings += judge_coverage(found, world)
  return Verdict(findings, draw(found, world, extent), notes)
