"""Brings the colours of films and photographs to those of a robot's camera and of screens.

Phones film in HDR and photograph in Display P3 unless told otherwise. Taken for what a robot's
camera gives, such colours are pale, and a film's shadows too bright. So light is made of the
signal, its primaries are exchanged, and a signal is made of it again: BT.709's for films, which
differs from sRGB's by less than cameras do.

Sources: ITU-R BT.709 (transfer), BT.2100 (HLG, PQ), BT.2408 (white of standard range is HLG's 75 %
and PQ's 203 cd/m2), SMPTE EG 432-1 (P3 with daylight's white). Shape letters: H height, W width.
"""

import functools
import io
from collections.abc import Callable

import av
import cv2
import numpy as np
import PIL.Image
import PIL.ImageCms
from av.video.reformatter import ColorPrimaries, ColorTrc

_BT709 = ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060))  # red, green and blue: x, y of CIE 1931
_PRIMARIES = {
  int(ColorPrimaries.BT2020): ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
  int(ColorPrimaries.SMPTE432): ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
_WHITE = (0.3127, 0.3290)  # of them all
_HLG_WHITE = 0.75  # signal of white
_PQ_WHITE = 203.0  # cd/m2
_LEVELS = 1 << 16  # of a signal and of light, in tables
_FULL = 255 << 8  # FFmpeg's level of a full signal


def _hlg(signal: np.ndarray) -> np.ndarray:
  """Light of a scene [1: of white] of HLG's signal (BT.2100, inverse OETF)."""

  def light(signal: np.ndarray) -> np.ndarray:
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)

  return light(signal) / light(np.array(_HLG_WHITE))


def _pq(signal: np.ndarray) -> np.ndarray:
  """Light of a screen [1: of white] of PQ's signal (BT.2100, EOTF), as a scene's (BT.1886)."""
  m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
  power = signal ** (1 / m2)
  shown = 1e4 * (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1) / _PQ_WHITE
  return _standard_light(shown ** (1 / 2.4))


def _standard_light(signal: np.ndarray) -> np.ndarray:
  """Light of a scene of BT.709's signal."""
  return np.where(signal < 0.081, signal / 4.5, ((signal + 0.099) / 1.099) ** (1 / 0.45))


def _standard_signal(light: np.ndarray) -> np.ndarray:
  """BT.709's signal of a scene's light."""
  return np.where(light < 0.018, 4.5 * light, 1.099 * np.maximum(light, 0.018) ** 0.45 - 0.099)


_HDR = {int(ColorTrc.ARIB_STD_B67): ("HLG", _hlg), int(ColorTrc.SMPTE2084): ("PQ", _pq)}


def hdr_name(frame: av.VideoFrame) -> str | None:
  """Name of the HDR system that a film's frame is of, None of one of standard range."""
  return _HDR[frame.color_trc][0] if frame.color_trc in _HDR else None


def standard(frame: av.VideoFrame) -> Callable[[np.ndarray], np.ndarray] | None:
  """How pictures of a film come to BT.709.

  Returns:
    None where they are BT.709's or the film does not say; else what makes BGR uint8 [H, W, 3] of
    BGR uint16 [H, W, 3], FFmpeg's bgr48. What is brighter than white is white.
  """
  if frame.color_trc not in _HDR and frame.color_primaries not in _PRIMARIES:
    return None
  return functools.partial(_to_standard, frame.color_trc, frame.color_primaries)


def _to_standard(trc: int, primaries: int, picture: np.ndarray) -> np.ndarray:
  light, signal = _tables(trc)
  linear = light[picture]
  if primaries in _PRIMARIES:
    exchange = np.linalg.inv(_xyz_from_rgb(_BT709)) @ _xyz_from_rgb(_PRIMARIES[primaries])
    linear = cv2.transform(linear, exchange[::-1, ::-1])  # OpenCV's order of colours
  return signal[np.round((_LEVELS - 1) * np.clip(linear, 0, 1)).astype(np.uint16)]


@functools.cache
def _tables(trc: int) -> tuple[np.ndarray, np.ndarray]:
  """Light float32 of each level of a film's signal, and BT.709's signal uint8 of each of light."""
  signal = np.minimum(np.arange(_LEVELS) / _FULL, 1)
  light = _HDR[trc][1](signal) if trc in _HDR else _standard_light(signal)
  standard_signal = _standard_signal(np.linspace(0, 1, _LEVELS))
  return light.astype(np.float32), np.round(255 * standard_signal).astype(np.uint8)


def _xyz_from_rgb(primaries: tuple[tuple[float, float], ...]) -> np.ndarray:
  """Matrix [3, 3] from light of primaries to CIE XYZ, whose white is that of daylight (D65)."""

  def xyz(x: float, y: float) -> list[float]:
    return [x / y, 1.0, (1 - x - y) / y]

  columns = np.array([xyz(*of) for of in primaries]).T
  return columns * np.linalg.solve(columns, xyz(*_WHITE))


def to_srgb(picture: np.ndarray, profile: bytes | None) -> np.ndarray:
  """Returns a photograph BGR uint8 [H, W, 3] of an ICC profile in sRGB.

  The picture itself where it has no profile, one of sRGB, or none that can be read for its colours.
  """
  if not profile:
    return picture
  try:
    found = PIL.ImageCms.ImageCmsProfile(io.BytesIO(profile))
    if found.profile.xcolor_space.strip() != "RGB" or "sRGB" in (
      found.profile.profile_description or ""
    ):
      return picture
    rgb = PIL.Image.fromarray(picture[..., ::-1].copy())
    made = PIL.ImageCms.profileToProfile(rgb, found, PIL.ImageCms.createProfile("sRGB"))
  except (OSError, PIL.ImageCms.PyCMSError):
    return picture
  return picture if made is None else np.asarray(made)[..., ::-1].copy()
