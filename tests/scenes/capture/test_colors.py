"""Colours of films in HDR and of photographs in Display P3, against published values."""

import struct

import av
import cv2
import numpy as np
import PIL.Image
import pytest

from nerf2real.scenes.capture.media import colors, stills
from nerf2real.scenes.capture.media.video import inspect_video, sharpest_frames

BT709, BT2020, P3, PQ, HLG = 1, 9, 12, 16, 18  # numbers of ITU-T H.273


def _film(path, signal, *, trc, primaries, codec="libx265", pixels="yuv420p10le"):
  """Writes a film of grey pictures of a signal (0 to 1), 10 bits of narrow range."""
  with av.open(str(path), "w") as container:
    stream = container.add_stream(codec, rate=30, options={"x265-params": "log-level=none"})
    stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
    context = stream.codec_context
    context.colorspace, context.color_primaries, context.color_trc = BT2020, primaries, trc
    for number in range(3):
      frame = av.VideoFrame(64, 48, pixels)
      for plane, level in zip(frame.planes, (round(64 + 876 * signal), 512, 512), strict=True):
        plane.update(np.full(plane.buffer_size // 2, level, np.uint16).tobytes())
      frame.pts = number
      container.mux(stream.encode(frame))
    container.mux(stream.encode())
  return path


def _read(path):
  warnings: list[str] = []
  info = inspect_video(path)
  frames = list(sharpest_frames(path, 2, max_size=64, info=info, warnings=warnings))
  return frames[0].image[24, 32], warnings


@pytest.mark.parametrize(
  ("trc", "signal", "expected"),
  [
    (HLG, 0.75, 255),  # BT.2408, table 1: white, of 100 % reflectance
    (HLG, 0.38, 104),  # and a grey card of 18 %, which BT.709 has at 40.9 %
    (HLG, 0.0, 0),
    (HLG, 1.0, 255),
    (PQ, 0.58, 255),
  ],
)
def test_a_film_in_hdr_is_brought_to_the_standard_range(tmp_path, trc, signal, expected):
  found, warnings = _read(_film(tmp_path / "hdr.mp4", signal, trc=trc, primaries=BT2020))
  np.testing.assert_allclose(found, expected, atol=2)
  assert len(warnings) == 1 and "is HDR" in warnings[0]


def test_a_film_of_standard_range_stays_as_it_is(tmp_path):
  found, warnings = _read(_film(tmp_path / "film.mp4", 0.5, trc=BT709, primaries=BT709))
  np.testing.assert_allclose(found, 128, atol=1)
  assert not warnings


def test_primaries_are_exchanged(tmp_path):
  """By the matrix of BT.2087, which has four digits."""
  path = _film(tmp_path / "film.mp4", 0.5, trc=BT709, primaries=BT2020)
  with av.open(str(path)) as container:
    convert = colors.standard(next(container.decode(video=0)))
  assert convert is not None
  matrix = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
  )
  light = np.array([0.5, 0.4, 0.3])
  signal = 1.099 * light**0.45 - 0.099
  found = convert(np.round(65280 * signal[::-1]).astype(np.uint16)[None, None])[0, 0, ::-1]
  np.testing.assert_allclose(found, 255 * (1.099 * (matrix @ light) ** 0.45 - 0.099), atol=0.6)


def _icc(red, green, blue, description):
  """A matrix profile with sRGB's curve, its colours adapted to D50 (ICC.1:2010)."""

  def fixed(*values):
    return b"".join(struct.pack(">i", round(65536 * value)) for value in values)

  def xyz(*values):
    return b"XYZ \0\0\0\0" + fixed(*values)

  curve = b"para\0\0\0\0" + struct.pack(">HH", 3, 0)
  curve += fixed(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
  text = description.encode() + b"\0"
  words = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(78)
  tags = {b"desc": words, b"cprt": b"text\0\0\0\0none\0", b"wtpt": xyz(0.9642, 1.0, 0.8249)}
  tags |= {b"rXYZ": xyz(*red), b"gXYZ": xyz(*green), b"bXYZ": xyz(*blue)}
  tags |= {name: curve for name in (b"rTRC", b"gTRC", b"bTRC")}
  table, data = struct.pack(">I", len(tags)), b""
  start = 128 + 4 + 12 * len(tags)
  for name, content in tags.items():
    table += name + struct.pack(">II", start + len(data), len(content))
    data += content + bytes(-len(content) % 4)
  head = struct.pack(
    ">I4sI4s4s4s", start + len(data), b"lcms", 0x02400000, b"mntr", b"RGB ", b"XYZ "
  )
  head += bytes(12) + b"acsp" + bytes(28) + fixed(0.9642, 1.0, 0.8249)
  return head.ljust(128, b"\0") + table + data


DISPLAY_P3 = _icc(
  (0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407), "P3"
)


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_photograph_in_display_p3_is_brought_to_srgb(tmp_path, suffix):
  """sRGB's red is 0.9176, 0.2003, 0.1386 in Display P3 (CSS Color Module 4)."""
  path = tmp_path / f"photo.{suffix}"
  picture = np.full((32, 32, 3), np.round(255 * np.array([0.9176, 0.2003, 0.1386])), np.uint8)
  PIL.Image.fromarray(picture).save(path, icc_profile=DISPLAY_P3, quality=100, subsampling=0)
  np.testing.assert_allclose(stills.read_still(path)[16, 16], [0, 0, 255], atol=6)


GREYS = [(1, 1, 1)] * 3


@pytest.mark.parametrize("profile", [None, b"no profile", _icc(*GREYS, "sRGB IEC61966-2.1")])
def test_a_photograph_of_no_other_profile_stays_as_it_is(tmp_path, profile):
  path = tmp_path / "photo.png"
  picture = np.random.default_rng(0).integers(0, 255, (16, 16, 3), np.uint8)
  PIL.Image.fromarray(picture).save(path, icc_profile=profile)
  np.testing.assert_array_equal(stills.read_still(path), cv2.imread(str(path)))
