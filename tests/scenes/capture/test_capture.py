"""Tests of reading captures: videos, pictures, posed data sets."""

import dataclasses
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from nerf2real.core.files import DiskFullError, disk_full
from nerf2real.scenes.capture import reading
from nerf2real.scenes.capture.capture import CaptureSettings
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.media.spacing import ImageMotion, spread
from nerf2real.scenes.capture.media.video import Frame, inspect_video, sharpest_frames, sharpness
from nerf2real.scenes.capture.reading import read_capture
from tests.scenes import synthetic_capture as synthetic

SETTINGS = CaptureSettings(num_keyframes=8)


@pytest.fixture(scope="module")
def frames():
  """Twenty-four views of the synthetic corner, blurred by different amounts."""
  poses = synthetic.walk(24)
  generator = np.random.default_rng(3)
  views = []
  for pose in poses:
    image = synthetic.render(pose)
    views.append(cv2.GaussianBlur(image, (0, 0), generator.uniform(0.3, 3)))
  return views


@pytest.mark.parametrize(
  ("codec", "suffix"),
  [("libx264", "mp4"), ("mpeg4", "mov"), ("libvpx-vp9", "webm"), ("mjpeg", "avi")],
)
def test_keeps_the_sharpest_frame_of_each_part(frames, tmp_path, codec, suffix):
  path = tmp_path / f"film.{suffix}"
  synthetic.write_video(path, frames, codec=codec)
  result = read_capture(path, tmp_path / "keyframes", settings=SETTINGS)
  with av.open(str(path)) as container:
    values = [sharpness(f.to_ndarray(format="gray")) for f in container.decode(video=0)]
  motion = ImageMotion()
  with av.open(str(path)) as container:
    moved = [motion.add(f.to_ndarray(format="gray")) for f in container.decode(video=0)]
  expected = spread(np.arange(24), np.array(moved), np.array(values), 8)
  assert [int(p.stem.split("_")[1]) for p in result.images] == expected.tolist()
  left = sorted(p.name for p in (tmp_path / "keyframes").iterdir())
  assert left == [p.name for p in result.images]
  np.testing.assert_allclose(result.sharpness, np.array(values)[expected])
  np.testing.assert_allclose(result.times, np.array(expected) / 10, atol=2e-3)
  assert all(path.is_file() for path in result.images)


@pytest.mark.parametrize(("most", "kept"), [(None, 3), (4, 4), (12, 5)])
def test_a_long_film_has_more_keyframes(frames, tmp_path, most, kept):
  path = tmp_path / "film.mp4"  # of 2.4 s
  synthetic.write_video(path, frames, codec="libx264")
  settings = CaptureSettings(num_keyframes=3, most_keyframes=most, min_images=3)
  assert len(read_capture(path, tmp_path / "keyframes", settings=settings).images) == kept


def test_keyframes_of_a_variable_rate_are_spread_over_time(frames, tmp_path):
  path = tmp_path / "film.mp4"
  with av.open(str(path), "w") as container:
    stream = container.add_stream("libx264", rate=100)
    stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
    stream.codec_context.time_base = Fraction(1, 100)
    for row, picture in enumerate(frames):
      frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
      frame.pts, frame.time_base = max(row, 30 * row - 12 * 29), Fraction(1, 100)
      container.mux(stream.encode(frame))
    container.mux(stream.encode())
  times = read_capture(path, tmp_path / "keyframes", settings=SETTINGS).times
  assert times[-1] > 3.0 and (times < 0.115).sum() == 2  # half of the frames, in a thirtieth of it


@pytest.mark.parametrize("rotation", [90, 180, -90])
def test_rotation_metadata_is_honoured(frames, tmp_path, rotation):
  path = tmp_path / "film.mp4"
  synthetic.write_video(path, frames, rotation=rotation)
  result = read_capture(path, tmp_path / "keyframes", settings=SETTINGS)
  image = cv2.imread(str(result.images[0]))
  index = int(result.images[0].stem.split("_")[1])
  with av.open(str(path)) as container:
    stored, side = next(
      (f.to_ndarray(format="bgr24"), [bytes(d) for d in f.side_data])
      for number, f in enumerate(container.decode(video=0))
      if number == index
    )
  # FFmpeg's display matrix itself: its angle is minus atan2 of the first row, counter-clockwise.
  matrix = np.frombuffer(next(d for d in side if len(d) == 36), "<i4")
  angle = -np.degrees(np.arctan2(matrix[1], matrix[0]))
  assert round(angle) % 360 == rotation % 360
  upright = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, -90: cv2.ROTATE_90_CLOCKWISE}
  expected = cv2.rotate(stored, upright[rotation])
  assert image.shape == expected.shape
  np.testing.assert_array_equal(image, expected)  # without loss


def test_large_pictures_are_reduced(frames, tmp_path):
  path = tmp_path / "film.mp4"
  synthetic.write_video(path, frames)
  settings = CaptureSettings(num_keyframes=8, max_size=160)
  result = read_capture(path, tmp_path / "keyframes", settings=settings)
  assert (result.width, result.height) == (160, 120)
  assert any("Low resolution" in line for line in result.warnings)


def test_holds_one_frame_at_a_time(frames, tmp_path):
  path = tmp_path / "film.mp4"
  synthetic.write_video(path, frames)
  chosen = sharpest_frames(path, 8, max_size=1920, info=inspect_video(path), warnings=[])
  assert next(chosen).index < 3  # the first part is out before the others are decoded


def test_warnings(frames, tmp_path):
  path = tmp_path / "film.mp4"
  synthetic.write_video(path, [cv2.GaussianBlur(f, (0, 0), 8) for f in frames])
  result = read_capture(path, tmp_path / "keyframes", settings=SETTINGS)
  text = "\n".join(result.warnings)
  assert "Too short: the video lasts 2.4 s" in text
  assert "Low resolution: 320x240" in text
  assert "Blur: 100%" in text
  assert "exposure" not in text
  dark = [np.uint8(f * (0.1 if row < 12 else 1.0)) for row, f in enumerate(frames)]
  synthetic.write_video(path, dark)
  result = read_capture(path, tmp_path / "keyframes", settings=SETTINGS)
  assert any("Changing exposure" in line for line in result.warnings)


def test_sharp_frames_give_no_blur_warning(tmp_path):
  path = tmp_path / "film.mp4"
  synthetic.write_video(path, [synthetic.render(pose) for pose in synthetic.walk(16)])
  result = read_capture(path, tmp_path / "keyframes", settings=SETTINGS)
  assert not any("Blur" in line for line in result.warnings)


def test_sharpness_is_comparable_between_resolutions(frames):
  grey = cv2.cvtColor(synthetic.texture(0, 1920), cv2.COLOR_BGR2GRAY)
  small = cv2.resize(grey, (960, 960), interpolation=cv2.INTER_AREA)
  assert sharpness(grey) == pytest.approx(sharpness(small), rel=0.1)


def test_damaged_video_says_until_where(frames, tmp_path):
  path = tmp_path / "film.avi"
  synthetic.write_video(path, frames, codec="mjpeg")
  data = path.read_bytes()
  path.write_bytes(data[: len(data) // 2])
  with pytest.raises(CaptureError, match=r"damaged: \d+ of 24 frames decoded, until \d\.\d s"):
    read_capture(path, tmp_path / "keyframes", settings=SETTINGS)
  assert not (tmp_path / "keyframes").exists()
  assert not list(tmp_path.glob("*partial*")) + list(tmp_path.glob(".*"))


def test_a_film_trimmed_without_loss_is_whole(frames, tmp_path):
  """Its container holds frames that an edit list hides, back to the keyframe before the cut."""
  synthetic.write_video(tmp_path / "film.mp4", frames)
  path = tmp_path / "trimmed.mp4"
  with (
    av.open(str(tmp_path / "film.mp4")) as whole,
    av.open(str(path), "w", options={"avoid_negative_ts": "disabled"}) as trimmed,
  ):
    stream = trimmed.add_stream_from_template(whole.streams.video[0])
    for packet in whole.demux(video=0):
      if packet.dts is not None:
        cut = round(0.8 / packet.time_base)
        packet.pts, packet.dts, packet.stream = packet.pts - cut, packet.dts - cut, stream
        trimmed.mux(packet)
  info = inspect_video(path)
  assert (info.num_frames, info.expected_frames) == (16, 16)
  result = read_capture(path, tmp_path / "keyframes", settings=SETTINGS)
  assert len(result.images) == 8 and not any("damaged" in line for line in result.warnings)


def test_overwritten_middle_is_damage(frames, tmp_path):
  path = tmp_path / "film.mp4"
  synthetic.write_video(path, frames)
  data = bytearray(path.read_bytes())
  start, length = len(data) // 4, len(data) // 3
  data[start : start + length] = np.random.default_rng(0).bytes(length)
  path.write_bytes(bytes(data))
  with pytest.raises(CaptureError, match="damaged"):
    read_capture(path, tmp_path / "keyframes", settings=SETTINGS)


def test_unusable_inputs_are_one_clear_line(frames, tmp_path):
  def message(source):
    with pytest.raises(CaptureError) as error:
      read_capture(source, tmp_path / "keyframes", settings=SETTINGS)
    text = str(error.value)
    assert "\n" not in text
    assert not (tmp_path / "keyframes").exists()
    return text

  assert "does not exist" in message(tmp_path / "nothing.mp4")
  (tmp_path / "empty.mp4").touch()
  assert "is empty (0 bytes)" in message(tmp_path / "empty.mp4")
  (tmp_path / "text.mp4").write_text("not a film at all, only words\n" * 20)
  assert "cannot be read as a video" in message(tmp_path / "text.mp4")
  synthetic.write_video(tmp_path / "short.mp4", frames[:4])
  assert "has 4 frames" in message(tmp_path / "short.mp4")
  (tmp_path / "void").mkdir()
  assert "holds no pictures" in message(tmp_path / "void")
  (tmp_path / "void" / "IMG_1.DNG").touch()
  assert "but 1 other files (.dng)" in message(tmp_path / "void")
  (tmp_path / "void" / "IMG_2.MOV").touch()
  assert "IMG_2.MOV, a video, and no pictures: give " in message(tmp_path / "void")
  folder = tmp_path / "three"
  folder.mkdir()
  for number in range(3):
    cv2.imwrite(str(folder / f"{number}.jpg"), frames[number])
  assert "holds 3 pictures, expected at least 8" in message(folder)
  assert "take more, from different places" in message(folder)
  (folder / "walk.MP4").touch()
  assert f"give the video {folder / 'walk.MP4'} itself" in message(folder)
  (folder / "walk.MP4").unlink()
  (folder / "images").mkdir()
  for number in range(4):
    (folder / "images" / f"{number}.jpg").touch()
  assert f"give {folder / 'images'}, which holds 4" in message(folder)
  other = tmp_path / "redwood"
  for name in ("rgb", "depth"):
    (other / name).mkdir(parents=True)
    cv2.imwrite(str(other / name / "0.png"), frames[0])
  assert "localised then, without depth." in message(other)
  (other / "trajectory.log").touch()
  said = message(other)
  assert f"such as {other / 'rgb'}; its pictures" in said and "depth, trajectory.log." in said
  for number in range(3, 9):
    cv2.imwrite(str(folder / f"{number}.jpg"), frames[number][:100])
  assert "expected one camera" in message(folder)
  (folder / "3.jpg").write_bytes(b"broken")
  assert "cannot be read as a picture" in message(folder)


def test_folder_of_images(frames, tmp_path):
  folder = tmp_path / "pictures"
  folder.mkdir()
  for number, frame in enumerate(frames):
    cv2.imwrite(str(folder / f"{number:02d}.png"), frame)
  reports = []
  result = read_capture(
    folder, tmp_path / "keyframes", settings=SETTINGS, progress=lambda f, t: reports.append((f, t))
  )
  values = [sharpness(cv2.cvtColor(f, cv2.COLOR_BGR2GRAY)) for f in frames]
  expected = [3 * part + int(np.argmax(values[3 * part : 3 * part + 3])) for part in range(8)]
  assert [int(p.stem.split("_")[1]) for p in result.images] == expected
  assert result.kind == "images"
  assert result.times is None
  fractions = [fraction for fraction, _ in reports]
  assert fractions == sorted(fractions)
  assert fractions[-1] == 1.0


def test_stills_without_a_place_are_named_as_their_files(tmp_path):
  names = synthetic.write_images(tmp_path / "in", synthetic.walk(10))
  capture = read_capture(tmp_path / "in", tmp_path / "out")
  keyframes = [path.name for path in capture.images]
  assert capture.without_place(keyframes) is None
  said = capture.without_place(keyframes[:3] + keyframes[4:])
  assert said is not None and said.startswith("1 of 10 pictures have no place and are not used: ")
  assert names[3] in said and names[2] not in said
  assert "and 2 more" in (capture.without_place(keyframes[6:]) or "")
  text = f"{keyframes[3]} sees fewest points (20)."
  assert capture.told(text) == f"{names[3]} sees fewest points (20)."
  film = dataclasses.replace(capture, origins=None)
  assert film.without_place([]) is None and film.told(text) == text


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_disk_that_fills_up_is_told_as_such(tmp_path):
  (tmp_path / "frame_000003.png").symlink_to("/dev/full")
  frame = Frame(3, 0.0, 1.0, np.zeros((4, 4, 3), np.uint8))
  with pytest.raises(DiskFullError, match="the disk is full"):
    reading._write(iter([frame]), tmp_path)


def test_an_error_leaves_the_last_good_keyframes(frames, tmp_path, monkeypatch):
  path = tmp_path / "film.mp4"
  synthetic.write_video(path, frames)
  first = read_capture(path, tmp_path / "keyframes", settings=SETTINGS)

  def full(path, *_):
    raise disk_full(path)

  monkeypatch.setattr(reading, "write_picture", full)
  with pytest.raises(DiskFullError, match="the disk is full"):
    read_capture(path, tmp_path / "keyframes", settings=SETTINGS)
  assert all(path.is_file() for path in first.images)
  assert not list(tmp_path.glob("*partial*")) + list(tmp_path.glob(".*"))
