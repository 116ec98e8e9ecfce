"""The robot's camera: the newest picture of a device, a file or a network stream, and its age.

A thread takes every frame as it comes and keeps the last one only, so that a slow reader never
works off a queue. Gain, exposure and white balance are fixed where the driver allows, and read
back. Shapes: H height, W width.
"""

import dataclasses
import json
import logging
import os
import re
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

OPEN_TIMEOUT = 10.0  # s until the first picture
_READ_TIMEOUT = 1.0  # s after which a silent network stream is opened anew
_RETRY = 0.5  # s between attempts to open a lost source
_TOLERANCE = 0.02  # relative: drivers round to their own steps
_MAX_DRIVER_AGE = 1.0  # s: an older driver's stamp is of another clock
_HTTP = ("http://", "https://")
_NETWORK = (*_HTTP, "rtsp://", "udp://", "tcp://")
_DEVICE = re.compile(r"/dev/video(\d+)")  # by-id and by-path are links to it
_MANUAL_EXPOSURE = 1.0  # V4L2's value of "manual" in CAP_PROP_AUTO_EXPOSURE
_log = logging.getLogger(__name__)

Source = int | str | Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class Controls:
  """What the camera shall hold fixed, in its driver's units; None leaves it as it is."""

  gain: float | None = None
  """The paper's Logitech C920 has 0 to 255, and 50 for navigation."""
  exposure: float | None = None
  """V4L2: units of 0.1 ms."""
  white_balance: float | None = None
  """Colour temperature, K."""

  def asked(self) -> dict[str, float]:
    """Returns what is given."""
    return {k: v for k, v in dataclasses.asdict(self).items() if v is not None}


@dataclasses.dataclass(frozen=True)
class Readback:
  """A control's requested value and the driver's."""

  asked: float
  found: float | None
  """None: the source has no such control."""

  @property
  def holds(self) -> bool:
    """Whether the driver took the value."""
    return self.found is not None and abs(self.found - self.asked) <= _TOLERANCE * max(
      1.0, abs(self.asked)
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CaptureSettings:
  """How a source is opened and what is held fixed."""

  capture_size: tuple[int, int] | None = None
  """Height and width requested of a device; None: its own."""
  controls: Controls = Controls()
  """What the camera shall hold fixed."""
  latency: float = 0.0
  """s from the light to the arrival of a frame, as measured; added to the age."""
  timeout: float = OPEN_TIMEOUT
  """s to wait for the first picture."""


class CameraLostError(RuntimeError):
  """No picture came from the camera in time."""


class Camera:
  """The newest picture of a source."""

  def __init__(
    self,
    source: Source,
    *,
    settings: CaptureSettings,
    capture: Callable[[Source], Any],
  ):
    """See `open`."""
    self.source = source
    self._settings, self._asked = settings, settings.controls
    self._make_capture = capture
    self._lock = threading.Condition()
    self._picture: np.ndarray | None = None  # full size, BGR
    self._taken = 0.0  # monotonic s
    self._stop = threading.Event()
    self.frames = 0  # that came
    self.reopened = 0  # times that the source was lost and found again
    self.readback: dict[str, Readback] = {}
    self._thread = threading.Thread(target=self._run, daemon=True, name=f"camera {source}")

  @classmethod
  def open(
    cls,
    source: Source,
    *,
    settings: CaptureSettings | None = None,
    capture: Callable[[Source], Any] | None = None,
  ) -> "Camera":
    """Opens a camera and waits for its first picture.

    Args:
      source: Number or path of a device, a video file (played at its own rate), or the URL of a
        stream.
      settings: Settings of the camera.
      capture: Opens a source as cv2.VideoCapture does; for tests.

    Raises:
      CameraLostError: No picture came.
      ValueError: The file does not exist.
    """
    if isinstance(source, Path) or (isinstance(source, str) and not source.startswith(_NETWORK)):
      number = _device_number(source)
      if number is not None:
        source = number
      elif not Path(source).exists():
        raise ValueError(f"Found no {source}: expected a device's number, a video file or a URL.")
    settings = settings or CaptureSettings()
    timeout = settings.timeout
    camera = cls(source, settings=settings, capture=capture or open_capture)
    camera._thread.start()
    with camera._lock:
      arrived = camera._lock.wait_for(lambda: camera._picture is not None, timeout)
    if not arrived:
      camera.close()
      raise CameraLostError(
        f"No picture came from the camera {source} in {timeout:g} s: check that it is plugged in "
        "(v4l2-ctl --list-devices), free, and that its number or address is right."
      )
    return camera

  def read(self) -> tuple[np.ndarray, float]:
    """Returns the newest picture as it came, RGB uint8 [H, W, 3], and its age [s].

    The age grows while no picture comes: the limit is the reader's.
    """
    with self._lock:
      picture, taken = self._picture, self._taken
    assert picture is not None  # `open` has waited for the first one
    age = time.monotonic() - taken + self._settings.latency
    return np.ascontiguousarray(picture[..., ::-1]), age

  def set_controls(self, controls: Controls) -> dict[str, Readback]:
    """Changes what is held fixed from now on; returns what the driver made of it.

    It is set at once, in the caller's thread, and again whenever the source is found anew.
    """
    self._asked = controls
    if _is_http(self.source):
      self.readback = _set_http(str(self.source), controls.asked())
    else:
      with self._lock:
        capture = self._capture
      self.readback = _set_device(capture, controls.asked())
    _report(self.source, self.readback)
    return self.readback

  def close(self) -> None:
    """Ends the thread and frees the device."""
    self._stop.set()
    if self._thread.is_alive():
      self._thread.join(2 * _READ_TIMEOUT + 1.0)

  def __enter__(self) -> "Camera":
    return self

  def __exit__(self, *_: object) -> None:
    self.close()

  # ---- the thread ----

  def _run(self) -> None:
    found_before = False
    while not self._stop.is_set():
      capture = self._make_capture(self.source)
      if capture.isOpened():
        if found_before:
          self.reopened += 1
          _log.warning("The camera %s is back.", self.source)
        found_before = True
        with self._lock:
          self._capture = capture
        self._set_up(capture)
        self._follow(capture)
        if self._is_file:
          capture.release()
          return  # a film ends; its last picture grows old
      capture.release()
      self._stop.wait(_RETRY)

  @property
  def _is_file(self) -> bool:
    return not isinstance(self.source, int) and not str(self.source).startswith(_NETWORK)

  def _set_up(self, capture: Any) -> None:
    if isinstance(self.source, int):
      capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
      if self._settings.capture_size is not None:
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._settings.capture_size[0])
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._settings.capture_size[1])
    asked = self._asked.asked()
    if _is_http(self.source):
      self.readback = _set_http(str(self.source), asked)
    elif isinstance(self.source, int):
      self.readback = _set_device(capture, asked)
    else:
      self.readback = {name: Readback(value, None) for name, value in asked.items()}
    _report(self.source, self.readback)

  def _follow(self, capture: Any) -> None:
    """Takes pictures until the source is lost."""
    rate = capture.get(cv2.CAP_PROP_FPS) if self._is_file else 0.0
    begin, count = time.monotonic(), 0
    while not self._stop.is_set():
      found, picture = capture.read()
      arrived = time.monotonic()
      if not found or picture is None:
        return
      with self._lock:
        self._picture, self._taken = picture, self._stamp(capture, arrived)
        self.frames += 1
        self._lock.notify_all()
      count += 1
      if self._is_file and rate > 0:
        self._stop.wait(max(0.0, begin + count / rate - time.monotonic()))

  def _stamp(self, capture: Any, arrived: float) -> float:
    """Returns when a picture was taken [monotonic s]: V4L2's stamp where there is one."""
    if isinstance(self.source, int):
      taken = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
      if 0 <= arrived - taken <= _MAX_DRIVER_AGE:
        return taken
    return arrived


def _device_number(source: str | Path) -> int | None:
  """Returns the number of a device given by "0", /dev/video0 or a link to that; None of others.

  As a file it would be played at the rate that its driver states, and its queue would grow old.
  """
  if str(source).isdecimal():
    return int(str(source))
  found = _DEVICE.fullmatch(os.path.realpath(source))
  return None if found is None else int(found[1])


def open_capture(source: Source) -> Any:
  """Opens a source with OpenCV."""
  if isinstance(source, int):
    return cv2.VideoCapture(source)
  if str(source).startswith(_NETWORK):
    milliseconds = [int(1000 * OPEN_TIMEOUT), int(1000 * _READ_TIMEOUT)]
    return cv2.VideoCapture(
      str(source),
      cv2.CAP_FFMPEG,
      [
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
        milliseconds[0],
        cv2.CAP_PROP_READ_TIMEOUT_MSEC,
        milliseconds[1],
      ],
    )
  return cv2.VideoCapture(str(source))


def _is_http(source: Source) -> bool:
  return isinstance(source, str) and source.startswith(_HTTP)


def _set_device(capture: Any, asked: Mapping[str, float]) -> dict[str, Readback]:
  """Sets a device's controls, automatic ones off first, and reads them back."""
  properties = {
    "gain": ((), cv2.CAP_PROP_GAIN),
    "exposure": (((cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE),), cv2.CAP_PROP_EXPOSURE),
    "white_balance": (((cv2.CAP_PROP_AUTO_WB, 0.0),), cv2.CAP_PROP_WB_TEMPERATURE),
  }
  found = {}
  for name, value in asked.items():
    switches, control = properties[name]
    held = all(capture.set(switch, state) for switch, state in switches)
    accepted = capture.set(control, value)
    found[name] = Readback(value, float(capture.get(control)) if held and accepted else None)
  return found


def _set_http(url: str, asked: Mapping[str, float]) -> dict[str, Readback]:
  """Sets a network camera's controls beside its stream, and reads them back."""
  if not asked:
    return {}
  address = urllib.parse.urljoin(url, "controls")
  try:
    query = urllib.parse.urlencode(asked)
    urllib.request.urlopen(f"{address}?{query}", timeout=_READ_TIMEOUT).close()
    with urllib.request.urlopen(address, timeout=_READ_TIMEOUT) as answer:
      values = json.load(answer)
  except (urllib.error.URLError, TimeoutError, ValueError):
    values = {}
  return {
    name: Readback(value, float(values[name]) if name in values else None)
    for name, value in asked.items()
  }


def _report(source: Source, readback: Mapping[str, Readback]) -> None:
  for name, value in readback.items():
    if not value.holds:
      found = "no such control" if value.found is None else f"{value.found:g}"
      _log.warning(
        "The camera %s does not hold its %s: asked for %g, found %s. Set it by hand "
        "(v4l2-ctl --list-ctrls) or expect other pictures than in training.",
        source,
        name,
        value.asked,
        found,
      )
