"""Photographs of a folder: those of one camera, zoom and orientation are kept."""

import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest

from nerf2real.scenes.capture import stills
from nerf2real.scenes.capture.capture import CaptureSettings, read_capture
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.capture.video import CaptureError


def _still(path, size, *, focal=None, orientation=None):
  """Writes noise of a size (width, height) with EXIF tags."""
  pixels = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
  exif = PIL.Image.Exif()
  if orientation is not None:
    exif[PIL.ExifTags.Base.Orientation] = orientation
  if focal is not None:
    exif.get_ifd(PIL.ExifTags.IFD.Exif)[PIL.ExifTags.Base.FocalLengthIn35mmFilm] = focal
  PIL.Image.fromarray(pixels).save(path, exif=exif)


def test_most_stills_are_kept_and_the_rest_is_named(tmp_path):
  for number in range(12):
    focal = 13 if number in (3, 4) else 26
    orientation = 6 if number == 7 else 1
    _still(tmp_path / f"{number:02d}.jpg", (160, 120), focal=focal, orientation=orientation)
  files = sorted(tmp_path.iterdir())
  kept, warnings = stills.of_one_camera(files)
  assert [path.stem for path in kept] == [f"{k:02d}" for k in range(12) if k not in (3, 4, 7)]
  assert len(warnings) == 1
  for text in ("Only 9 of 12", "2 of 160x120 with a lens of 13 mm", "1 of 120x160"):
    assert text in warnings[0]
  capture = read_capture(tmp_path, tmp_path / "out", settings=CaptureSettings(num_keyframes=20))
  assert len(capture.images) == 9 and warnings[0] in capture.warnings
  with pytest.raises(CaptureError, match="At least 10 such pictures"):
    read_capture(tmp_path, tmp_path / "out", settings=CaptureSettings(min_images=10))


def test_stills_of_one_look_are_all_kept(tmp_path):
  for number in range(3):
    _still(tmp_path / f"{number}.png", (40, 30))
  files = sorted(tmp_path.iterdir())
  assert stills.of_one_camera(files) == (files, [])
  assert stills.look_of(files[0]) == (40, 30, None)


def test_apples_format_is_named(tmp_path):
  (tmp_path / "IMG_0001.HEIC").write_bytes(b"ftypheic")
  with pytest.raises(CaptureError, match=r"1 pictures such as IMG_0001\.HEIC.*convert them"):
    source_kind(tmp_path)
