"""Photographs of a folder: those of one camera are kept, turned alike, each once."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest

from nerf2real.core.files import hash_path
from nerf2real.scenes.capture import keyframes
from nerf2real.scenes.capture.capture import CaptureSettings
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.capture.media import stills
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses.matching.features import FeatureSettings
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.structure_from_motion import localise
from nerf2real.scenes.poses.unit_frame import mean_up
from tests.scenes import synthetic_capture as synthetic

HEIC = Path(__file__).with_name("wide.heic")  # 64x48, a lens of 26 mm, redder to the right
UPRIGHT = HEIC.with_name("upright.heic")  # the phone turned: 64x48 with EXIF's 6, blue at its right


def _still(path, size, *, focal=None, orientation=None, seed=0):
  """Writes noise of a size (width, height) with EXIF tags."""
  pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
  exif = PIL.Image.Exif()
  if orientation is not None:
    exif[PIL.ExifTags.Base.Orientation] = orientation
  if focal is not None:
    exif.get_ifd(PIL.ExifTags.IFD.Exif)[PIL.ExifTags.Base.FocalLengthIn35mmFilm] = focal
  PIL.Image.fromarray(pixels).save(path, exif=exif)


def test_a_lens_that_exif_tells_wrongly_is_not_known(tmp_path):
  for name, focal in (("one", 26), ("two", (26, 26)), ("none", 0)):
    _still(tmp_path / f"{name}.jpg", (80, 60), focal=focal)
  looks = [stills.look_of(tmp_path / f"{name}.jpg").focal for name in ("one", "two", "none")]
  assert looks == [26.0, None, None]


def test_most_stills_are_kept_and_the_rest_is_named(tmp_path):
  for number in range(12):
    focal = 13 if number in (3, 4) else None if number == 5 else 26
    size = (80, 60) if number == 8 else (320, 240) if number == 9 else (160, 120)
    orientation = 6 if number == 7 else 1
    path = tmp_path / f"{number:02d}.jpg"
    _still(path, size, focal=focal, orientation=orientation, seed=number)
  files = sorted(tmp_path.iterdir())
  found = stills.of_one_camera(files)
  kept = [k for k in range(12) if k not in (3, 4, 8)]
  assert [int(path.stem) for path in found.files] == kept
  np.testing.assert_array_equal(found.turned, [k == 7 for k in kept])
  assert found.long_side == 160 and len(found.warnings) == 1
  for text in ("Only 9 of 12", "2 of 160x120 with a lens of 13 mm", "1 of 80x60"):
    assert text in found.warnings[0]
  capture = read_capture(tmp_path, tmp_path / "out", settings=CaptureSettings(num_keyframes=20))
  assert len(capture.images) == 9 and found.warnings[0] in capture.warnings
  assert (capture.width, capture.height) == (160, 120)
  keyframes.save(capture, tmp_path)
  again = keyframes.load(tmp_path, tmp_path / "out")
  np.testing.assert_array_equal(again.turned, found.turned)
  with pytest.raises(CaptureError, match="At least 10 different pictures"):
    read_capture(tmp_path, tmp_path / "out", settings=CaptureSettings(min_images=10))


def test_photographs_that_are_not_used_are_counted(tmp_path):
  for number in range(12):
    _still(tmp_path / f"{number:02d}.png", (160, 120), seed=number)
  settings = CaptureSettings(num_keyframes=8)
  some = read_capture(tmp_path, tmp_path / "some", settings=settings)
  assert len(some.images) == 8
  assert any(
    text.startswith("8 of 12 pictures are used") and "--keyframes 12 uses all" in text
    for text in some.warnings
  )
  settings = CaptureSettings(num_keyframes=8, most_keyframes=12)
  whole = read_capture(tmp_path, tmp_path / "whole", settings=settings)
  assert len(whole.images) == 12 and not any("are used" in text for text in whole.warnings)


def test_smaller_stills_are_kept_where_they_show_enough(tmp_path):
  sizes = [(2016, 1512)] * 4 + [(1600, 1200)] * 3 + [(1200, 1600), (1400, 1050), (1920, 1080)]
  sizes += [(1600, 1201)]  # rounded otherwise
  for number, size in enumerate(sizes):
    _still(tmp_path / f"{number:02d}.jpg", size, focal=26 if number < 4 else None, seed=number)
  found = stills.of_one_camera(sorted(tmp_path.iterdir()))
  assert [int(path.stem) for path in found.files] == [0, 1, 2, 3, 4, 5, 6, 7, 10]
  assert found.size(1920) == (1600, 1200) and found.size(800) == (800, 600)
  assert "1 of 1400x1050" in found.warnings[0] and "1 of 1920x1080" in found.warnings[0]
  capture = read_capture(tmp_path, tmp_path / "out")
  assert len(capture.images) == 9 and (capture.width, capture.height) == (1600, 1200)


def test_the_lens_that_most_files_tell_is_kept(tmp_path):
  focals = [None] * 5 + [26] * 3 + [13] * 2
  for number, focal in enumerate(focals):
    _still(tmp_path / f"{number:02d}.jpg", (40, 30), focal=focal, seed=number)
  found = stills.of_one_camera(sorted(tmp_path.iterdir()))
  assert len(found.files) == 8 and found.look.focal == 26
  assert "2 of 40x30 with a lens of 13 mm" in found.warnings[0]


def test_stills_of_one_look_are_all_kept_but_copies(tmp_path):
  for number in range(3):
    _still(tmp_path / f"{number}.png", (40, 30), seed=number)
  files = sorted(tmp_path.iterdir())
  found = stills.of_one_camera(files)
  assert found.files == files and not found.turned.any() and not found.warnings
  assert stills.look_of(files[0]) == (40, 30, None)
  shutil.copy(files[1], tmp_path / "1 (copy).png")
  found = stills.of_one_camera(sorted(tmp_path.iterdir()))
  assert len(found.files) == 3 and found.warnings == ["1 of 4 pictures are copies of others."]


def test_upright_stills_are_localised_with_wide_ones(tmp_path):
  for row, pose in enumerate(synthetic.walk(12)):
    if row % 3 == 1:  # the same camera held upright: rolled by a quarter
      roll = np.eye(4)
      roll[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
      picture = np.rot90(synthetic.render(pose @ roll), -1)
    else:
      picture = synthetic.render(pose)
    (tmp_path / "photos").mkdir(exist_ok=True)
    rgb = np.ascontiguousarray(picture[..., ::-1])
    PIL.Image.fromarray(rgb).save(tmp_path / "photos" / f"{row:02d}.png")
  capture = read_capture(tmp_path / "photos", tmp_path / "images")
  assert capture.turned.sum() == 4 and len(capture.images) == 12
  turned = [path.name for path, is_so in zip(capture.images, capture.turned, strict=True) if is_so]
  plain = LocaliseSettings(
    features=FeatureSettings(affine_shape=False, guided_matching=False, few_num_features=400)
  )
  found = localise(
    tmp_path / "images", tmp_path / "poses", settings=plain, turned=frozenset(turned)
  )
  assert found.registered_fraction == 1.0
  upright = stills.upright_poses(found.world_from_camera, capture.turned)
  up = mean_up(upright)
  np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
  ups = -upright[:, :3, 1]
  assert ups[:, 2].min() > 0.8  # each of them, as the walk looks down by 10 to 20 degrees


def test_apples_pictures_are_read(tmp_path):
  assert stills.look_of(HEIC) == (64, 48, 26.0)
  image = stills.read_still(HEIC)
  assert image.shape == (48, 64, 3)
  assert image[10, 60, 2] > 200 > 60 > image[10, 4, 2]  # BGR
  shutil.copy(HEIC, tmp_path / "IMG_0001.HEIC")
  assert source_kind(tmp_path) == "images"
  _still(tmp_path / "IMG_0001.jpg", (64, 48))  # converted from it
  assert [p.name for p in stills.of_one_camera(sorted(tmp_path.iterdir())).files] == [
    "IMG_0001.jpg"
  ]
  (tmp_path / "IMG_0002.HEIC").write_bytes(b"ftypheic")
  with pytest.raises(CaptureError, match=r"IMG_0002\.HEIC cannot be read as a picture"):
    stills.look_of(tmp_path / "IMG_0002.HEIC")


def test_what_is_no_picture_is_left_out_and_named(tmp_path):
  for number in range(8):
    _still(tmp_path / f"{number}.png", (160, 120), seed=number)
  (tmp_path / "._0.png").write_bytes(b"Mac OS X resource fork")
  assert "._0.png" not in [path.name for path in stills.list_images(tmp_path)]
  (tmp_path / "7a.png").touch()
  capture = read_capture(tmp_path, tmp_path / "out")
  assert len(capture.images) == 8
  assert "1 of 9 files cannot be read as a picture, left out: 7a.png." in capture.warnings
  _still(tmp_path / "8.bmp", (160, 120), seed=8)
  data = (tmp_path / "8.bmp").read_bytes()
  (tmp_path / "8.bmp").write_bytes(data[:300])  # its header is whole
  capture = read_capture(tmp_path, tmp_path / "out")
  assert len(capture.images) == 8 and not any("are used" in text for text in capture.warnings)
  assert any("1 of 9 files" in text and "8.bmp" in text for text in capture.warnings)
  (tmp_path / "7.png").write_bytes(b"broken")
  with pytest.raises(CaptureError, match="left out: 7.png, 7a.png.* At least 8 different"):
    read_capture(tmp_path, tmp_path / "out")
  with pytest.raises(CaptureError, match="1 of 1 files cannot be read as a picture, left out: 7a"):
    stills.of_one_camera([tmp_path / "7a.png"])


def test_transparent_parts_keep_their_colour(tmp_path):
  pixels = np.full((4, 6, 4), (10, 20, 30, 0), np.uint8)
  PIL.Image.fromarray(pixels).save(tmp_path / "clear.png")
  np.testing.assert_array_equal(stills.read_still(tmp_path / "clear.png")[0, 0], [30, 20, 10])


def test_a_picture_that_pil_takes_for_a_bomb_is_read(tmp_path, monkeypatch):
  _still(tmp_path / "huge.jpg", (64, 48))
  monkeypatch.setattr(PIL.Image, "MAX_IMAGE_PIXELS", 1000)
  assert stills.look_of(tmp_path / "huge.jpg") == (64, 48, None)
  assert stills.read_still(tmp_path / "huge.jpg", least=32).shape == (24, 32, 3)
  assert PIL.Image.MAX_IMAGE_PIXELS == 1000


def test_an_apple_picture_of_a_turned_phone_is_upright():
  assert stills.look_of(UPRIGHT) == (48, 64, 26.0)
  image = stills.read_still(UPRIGHT)
  assert image.shape == (64, 48, 3)
  assert image[30, 40, 0] > 150 > 60 > image[30, 8, 0]  # BGR: the file's upper half is at the right
  assert image[60, 24, 2] > 200 > 60 > image[4, 24, 2]  # and its right half below


@pytest.mark.parametrize(
  ("least", "size"), [(None, (640, 480)), (400, (640, 480)), (200, (320, 240)), (60, (80, 60))]
)
def test_large_photographs_are_decoded_no_larger_than_needed(tmp_path, least, size):
  coarse = np.random.default_rng(4).integers(0, 255, (12, 16, 3), np.uint8)
  pixels = cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)
  exif = PIL.Image.Exif()
  exif[PIL.ExifTags.Base.Orientation] = 6
  PIL.Image.fromarray(pixels).save(tmp_path / "large.jpg", quality=95, exif=exif)
  image = stills.read_still(tmp_path / "large.jpg", least=least)
  assert image.shape == (*size, 3)  # upright
  expected = cv2.resize(np.rot90(pixels, -1), size[::-1], interpolation=cv2.INTER_AREA)
  assert np.abs(image[..., ::-1].astype(int) - expected).mean() < 2


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_a_jpeg_with_apples_suffix_is_read_by_what_it_holds(tmp_path, orientation):
  """A messenger names what it has converted as it was."""
  for number in range(8):
    _still(tmp_path / "made.jpg", (64, 48), orientation=orientation, seed=number)
    (tmp_path / "made.jpg").rename(tmp_path / f"{number}.HEIC")
  expected = cv2.imread(str(tmp_path / "0.HEIC"))
  assert stills.look_of(tmp_path / "0.HEIC")[:2] == (48, 64) == expected.shape[1::-1]
  np.testing.assert_array_equal(stills.read_still(tmp_path / "0.HEIC"), expected)
  capture = read_capture(tmp_path, tmp_path / "out")
  assert (capture.width, capture.height) == (48, 64)


def test_an_apple_picture_with_a_jpegs_suffix_is_read_by_what_it_holds(tmp_path):
  shutil.copy(UPRIGHT, tmp_path / "0.jpg")
  np.testing.assert_array_equal(stills.read_still(tmp_path / "0.jpg"), stills.read_still(UPRIGHT))
  np.testing.assert_array_equal(
    stills.read_still(tmp_path / "0.jpg", least=16), stills.read_still(UPRIGHT)
  )


def test_a_picture_that_is_not_as_its_header_tells_is_left_out(tmp_path, monkeypatch):
  for number in range(9):
    _still(tmp_path / f"{number}.png", (640, 480), seed=number)
  read = stills.read_still

  def turned(path, **how):
    return np.rot90(read(path, **how)) if path.name == "3.png" else read(path, **how)

  monkeypatch.setattr(stills, "read_still", turned)
  capture = read_capture(tmp_path, tmp_path / "out", settings=CaptureSettings(num_keyframes=9))
  assert capture.origins == [f"{k}.png" for k in range(9) if k != 3]


@pytest.mark.parametrize("orientation", [3, 5, 6, 8])
def test_a_turned_tiff_is_read_once_turned(tmp_path, orientation, capfd):
  pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
  exif = PIL.Image.Exif()
  exif[PIL.ExifTags.Base.Orientation] = orientation
  for suffix in (".tif", ".png"):
    PIL.Image.fromarray(pixels).save(tmp_path / f"still{suffix}", exif=exif)
  tiff, png = tmp_path / "still.tif", tmp_path / "still.png"
  image = stills.read_still(tiff)
  np.testing.assert_array_equal(image, stills.read_still(png))
  assert stills.look_of(tiff)[:2] == image.shape[1::-1] == stills.look_of(png)[:2]
  np.testing.assert_array_equal(stills.read_still(tiff, upright=False), pixels[..., ::-1])
  assert not capfd.readouterr().err


def test_a_tiff_of_sixteen_bits_keeps_its_brightness(tmp_path):
  grey = np.linspace(0, 65535, 64 * 48).reshape(48, 64).astype(np.uint16)
  cv2.imwrite(str(tmp_path / "still.tif"), grey)
  expected = np.repeat(grey[..., None] // 256, 3, axis=-1)
  np.testing.assert_array_equal(stills.read_still(tmp_path / "still.tif"), expected)


@pytest.mark.parametrize("filled", [False, True])
def test_a_jpeg_that_was_cut_off_is_left_out_and_named(tmp_path, filled):
  for number in range(9):
    _still(tmp_path / f"{number}.jpg", (64, 48), seed=number)
  exif = PIL.Image.Exif()
  thumbnail = (tmp_path / "0.jpg").read_bytes()[:4000] + b"\xff\xd9"  # an end within a segment
  exif[PIL.ExifTags.Base.ImageDescription] = thumbnail.decode("latin-1")
  with PIL.Image.open(tmp_path / "4.jpg") as image:
    image.save(tmp_path / "4.jpg", exif=exif)
  data = (tmp_path / "4.jpg").read_bytes()
  kept = len(data) - 1500
  (tmp_path / "4.jpg").write_bytes(data[:kept] + (bytes(1500) if filled else b""))
  (tmp_path / "5.jpg").write_bytes((tmp_path / "5.jpg").read_bytes() + b"a film of the moment")
  capture = read_capture(tmp_path, tmp_path / "out", settings=CaptureSettings(num_keyframes=9))
  assert len(capture.images) == 8
  assert "1 of 9 files cannot be read as a picture, left out: 4.jpg." in capture.warnings


def test_pictures_that_are_all_lost_are_named(tmp_path):
  for number in range(8):
    _still(tmp_path / f"{number}.jpg", (64, 48), seed=number)
    data = (tmp_path / f"{number}.jpg").read_bytes()
    (tmp_path / f"{number}.jpg").write_bytes(data[: len(data) // 2])
  with pytest.raises(CaptureError, match=r"8 of 8 .* left out: 0\.jpg, 1\.jpg.* At least 8"):
    read_capture(tmp_path, tmp_path / "out")


def test_depth_maps_beside_photographs_are_left_out(tmp_path):
  for number in range(8):
    _still(tmp_path / f"frame{number}.png", (64, 48), seed=number)
    depth = np.random.default_rng(number).integers(900, 4000, (48, 64)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / f"depth{number}.png"), depth)
  capture = read_capture(tmp_path, tmp_path / "out")
  assert capture.origins == [f"frame{number}.png" for number in range(8)]
  assert any("8 of 16 pictures are depth maps" in text for text in capture.warnings)
  for path in tmp_path.glob("frame*"):
    path.unlink()
  assert len(stills.of_one_camera(sorted(tmp_path.glob("*.png"))).files) == 8  # grey photographs


def test_a_name_that_is_no_utf8_is_read_and_shown_with_a_mark(tmp_path):
  folder = tmp_path / "photos"
  folder.mkdir()
  for number in range(8):
    _still(folder / f"{number}.png", (64, 48), seed=number)
  os.rename(folder / "3.png", os.fsencode(folder) + b"/caf\xe9.png")
  assert len(hash_path(folder)) == 64
  capture = read_capture(folder, tmp_path / "out")
  assert len(capture.images) == 8 and "caf\N{REPLACEMENT CHARACTER}.png" in capture.origins
  odd = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9")
  os.rename(folder, odd)
  with pytest.raises(CaptureError, match="is no UTF-8: rename it"):
    source_kind(Path(odd))
