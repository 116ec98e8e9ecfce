"""Verdicts on captures: blur, exposure, gaps, the loop, and which side of a room was not filmed."""

import types

import numpy as np
import pytest

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.capture.capture import Capture, CaptureSettings, quality_warnings
from nerf2real.scenes.poses.tracks import Tracks
from nerf2real.scenes.quality import advice
from nerf2real.scenes.quality.coverage import coverage
from tests.scenes import furnished_room
from tests.scenes.synthetic_model import NO_TRACKS

CAMERA = Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
EXTENT = (np.array([-2.5, -2.0, 0.0]), np.array([2.5, 2.0, 2.5]))


def _capture(tmp_path, *, blur=1.0, brightness=120.0, count=20) -> Capture:
  return Capture(
    kind="video",
    folder=tmp_path,
    images=[tmp_path / f"frame_{k:06d}.jpg" for k in range(count)],
    width=640,
    height=480,
    sharpness=np.full(count, 100.0),
    brightness=np.broadcast_to(brightness, count),
    times=3.0 * np.arange(count),
    warnings=[],
    blur=np.broadcast_to(blur, count),
  )


def test_good_pictures_are_good_and_bad_ones_are_named_with_their_times(tmp_path):
  good = advice.judge_pictures(_capture(tmp_path), CaptureSettings())
  assert all(finding.good for finding in good)
  values = np.full(20, 1.0)
  values[4:12] = 5.0
  light = np.where(np.arange(20) < 5, 30.0, 200.0)
  blur, exposure = advice.judge_pictures(
    _capture(tmp_path, blur=values, brightness=light), CaptureSettings()
  )
  assert not blur.good and "40%" in blur.text and "0:12 to 0:33" in blur.text
  assert not exposure.good and "factor of 6.7" in exposure.text


def _poses(yaws, tilt):
  """Cameras in the middle of the room that look around at an angle downwards."""
  middle = np.array([0.0, 0.0, 1.4])
  eyes = middle + 0.4 * np.stack([np.cos(yaws), np.sin(yaws), 0 * yaws], -1)
  ways = np.stack([np.cos(yaws), np.sin(yaws), 0 * yaws - np.tan(tilt)], -1)
  return np.array([furnished_room.look_at(e, e + w) for e, w in zip(eyes, ways, strict=True)])


def test_a_walk_that_looks_everywhere_covers_floor_and_walls():
  around = np.linspace(0, 2 * np.pi, 40, endpoint=False)
  poses = np.concatenate([_poses(around, 0.2), _poses(around, 0.9)])
  found = coverage(CAMERA, poses, EXTENT)
  assert found.shares[0] > 0.9 and found.shares[1] > 0.9
  assert all(finding.good for finding in advice.judge_coverage(found, poses))


def test_the_side_that_was_not_filmed_is_named_and_drawn():
  poses = _poses(np.linspace(-1.0, 1.0, 40), 0.3)  # towards +x only: 12 o'clock is 57 degrees right
  found = coverage(CAMERA, poses, EXTENT)
  bare = np.concatenate([found.floor[~found.floor_covered], found.walls[~found.walls_covered]])
  assert bare[:, 0].mean() < -0.3
  walls = advice.judge_coverage(found, poses)[1]
  assert not walls.good
  hours = {int(word) for word in walls.text.replace(",", "").split() if word.isdigit()}
  # -x lies 123 degrees to the right of the first picture: 4 o'clock
  assert hours & {3, 4, 5} and not hours & {10, 11, 1}
  picture = advice.draw(found, poses, EXTENT)
  legend = len(advice._LEGEND) * advice._LEGEND_ROW
  assert (picture[-legend:] == advice._GAP).all(-1).any()
  picture = picture[:-legend]
  marked = (picture == advice._GAP).all(-1)
  assert marked[:, : picture.shape[1] // 2].sum() > 2 * marked[:, picture.shape[1] // 2 :].sum()


def test_hours_of_the_picture_are_those_of_the_words():
  poses = _poses(np.array([0.4, 1.0, 2.0]), 0.3)
  hours = np.arange(1, 13)
  middle = np.median(poses[:, :2, 3], axis=0)
  places = middle + 2 * advice._clock(poses, hours)
  for hour, place in zip(hours, places, strict=True):
    assert advice._direction(place[None], poses) == f"{hour} o'clock"
  np.testing.assert_allclose(
    places[-1] - middle, 2 * poses[0, :2, 2] / np.linalg.norm(poses[0, :2, 2])
  )


@pytest.mark.parametrize(("last", "closed"), [(19, True), (5, False)])
def test_a_loop_is_closed_where_the_end_sees_what_the_beginning_saw(last, closed):
  views = np.repeat([0, last], 40)
  shared = advice._shared_points(Tracks(views, np.tile(np.arange(40), 2), np.zeros((80, 2))), 20)
  assert (shared >= advice._LOOP_POINTS) == closed


def test_a_film_of_which_parts_were_left_out_is_told_when(tmp_path):
  capture = _capture(tmp_path)
  names = [path.name for path in capture.images]
  poses = types.SimpleNamespace(names=names, left_out=(), tracks=NO_TRACKS)
  assert all(finding.name != "line" for finding in advice.judge_poses(capture, poses))
  poses.names, poses.left_out = [*names[:7], *names[9:]], tuple(names[7:9])
  found = {finding.name: finding for finding in advice.judge_poses(capture, poses)}
  assert not found["line"].good and found["poses"].good
  assert "from 21.0 s to 24.0 s" in found["line"].text and "film that part" in found["line"].text


def test_without_poses_the_verdict_is_the_reason(tmp_path):
  verdict = advice.judge(_capture(tmp_path), CaptureSettings(), reason="3 of 20 were localised.")
  assert not verdict.good and verdict.picture is None
  assert verdict.words.startswith("Film again") and "- bad: 3 of 20" in verdict.words
  assert advice._shared_points(NO_TRACKS, 0) is None


def test_what_was_assumed_is_told_and_what_is_judged_is_not_told_twice(tmp_path):
  capture = _capture(tmp_path, blur=5.0)
  capture.warnings.extend(quality_warnings(capture, CaptureSettings()))
  assert any("Blur" in text for text in capture.warnings)
  capture.warnings.append("Depth decides the metre.")
  poses = types.SimpleNamespace(
    names=[path.name for path in capture.images],
    left_out=(),
    tracks=NO_TRACKS,
    warnings=("frame_000003.jpg sees little.",),
    camera=CAMERA,
    world_from_camera=_poses(np.linspace(0, 6, 20), 0.3),
  )
  found = advice.judge(capture, CaptureSettings(), poses=poses, reason="no floor")
  assert found.notes == ["Depth decides the metre.", "frame_000003.jpg sees little."]
  frame = types.SimpleNamespace(
    world_from_unit=Similarity(1.0, np.eye(3), np.zeros(3)),
    extent_lower=EXTENT[0],
    extent_upper=EXTENT[1],
    warnings=("Metres were assumed.",),
  )
  words = advice.judge(capture, CaptureSettings(), poses=poses, frame=frame).words
  assert words.splitlines()[-1] == "- note: Metres were assumed."
  assert words.count("- note: ") == 3 and "Blur:" not in words
