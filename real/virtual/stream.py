"""The virtual robot's camera: an MJPEG stream over HTTP, as network cameras give it.

A JPEG encoder follows the sensor, and every frame leaves a fixed time after it was taken. Like a
webcam's driver it has controls that are read back: `GET /controls` gives them,
`GET /controls?gain=90` sets them (the gain in the units of the Logitech C920, in which 50 is
neutral).
"""

import json
import threading
import time
import urllib.parse
from collections import deque
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np

from nerf2real.real.virtual.camera import Sensor, VirtualCamera

NEUTRAL_GAIN = 50.0  # of the C920 (paper: the default of the navigation experiments)
MAX_GAIN, MAX_EXPOSURE = 255.0, 16.0  # the driver's ranges; of exposure in shares of the neutral
_JPEG_QUALITY = 85
_BOUNDARY = "frame"
_WAIT = 0.5  # s a client's thread waits for a frame before it looks whether the stream has ended


class CameraStream:
  """Takes pictures at a rate and serves them on the loopback address."""

  def __init__(
    self,
    render: Callable[[], np.ndarray],
    settings: VirtualCamera | None = None,
    *,
    release: Callable[[], None] = lambda: None,
    port: int = 0,
    seed: int = 0,
  ):
    """Opens the port; `start` begins to take pictures.

    Args:
      render: Returns the true picture now, RGB uint8 [H, W, 3]; always called from the stream's own
        thread, which may therefore own an OpenGL context that the first call makes.
      release: Frees what `render` made; called from the same thread when the pictures end.
      settings: Rate, latency and the sensor's response; the lens is the renderer's.
      port: 0 takes a free one.
      seed: Of the noise.
    """
    settings = settings or VirtualCamera()
    self._render, self._release = render, release
    self._period = 1.0 / settings.rate
    self._latency = settings.latency + settings.undeclared_latency
    self.sensor = Sensor(settings, seed=seed)
    self._blocked = False
    self._frozen = False
    self._due: deque[tuple[float, bytes]] = deque()
    self._newest: tuple[int, bytes] | None = None
    self._arrived = threading.Condition()
    self._stop = threading.Event()
    self.error: Exception | None = None  # what ended pictures and connections, if anything did
    stream = self

    class Handler(_Handler):
      camera = stream

    self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    self._server.daemon_threads = True
    self._threads: list[threading.Thread] = []

  @property
  def url(self) -> str:
    """Where the stream is."""
    return f"http://127.0.0.1:{self._server.server_port}/stream.mjpg"

  def start(self) -> None:
    """Starts to take and to send pictures."""
    if self._threads:
      return
    for run in (self._server.serve_forever, self._take_pictures):
      thread = threading.Thread(target=run, daemon=True, name=f"camera {run.__name__}")
      thread.start()
      self._threads.append(thread)

  def block(self, blocked: bool) -> None:
    """Covers the lens, or uncovers it."""
    self._blocked = blocked

  def freeze(self, frozen: bool) -> None:
    """Stops sending pictures while the connection stays, or goes on."""
    self._frozen = frozen

  def controls(self) -> dict[str, float]:
    """Returns the driver's settings."""
    return {"gain": self.sensor.gain * NEUTRAL_GAIN, "exposure": self.sensor.exposure}

  def set_controls(self, values: Mapping[str, float]) -> None:
    """Changes settings as a driver does: limited to their range, unknown ones are ignored."""
    if "gain" in values:
      self.sensor.gain = float(np.clip(values["gain"], 0.0, MAX_GAIN)) / NEUTRAL_GAIN
    if "exposure" in values:
      self.sensor.exposure = float(np.clip(values["exposure"], 0.0, MAX_EXPOSURE))

  def _take_pictures(self) -> None:
    try:
      self._take_until_stopped()
    except Exception as error:  # whatever a renderer raises: the robot's user is told of it
      self.error = error
    finally:
      self._release()

  def _take_until_stopped(self) -> None:
    due = time.monotonic()
    while not self._stop.is_set():
      taken = time.monotonic()
      if not self._frozen:
        picture = self._render()
        if self._blocked:
          picture = np.zeros_like(picture)
        encoded = cv2.imencode(
          ".jpg", self.sensor.develop(picture)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        )[1]
        self._due.append((taken + self._latency, encoded.tobytes()))
      due = max(due + self._period, time.monotonic() - self._period)
      self._deliver(due)

  def _deliver(self, until: float) -> None:
    """Sends what is due until a time [monotonic s]."""
    while not self._stop.is_set():
      now = time.monotonic()
      if self._due and self._due[0][0] <= now:
        _, data = self._due.popleft()
        with self._arrived:
          count = 0 if self._newest is None else self._newest[0] + 1
          self._newest = (count, data)
          self._arrived.notify_all()
        continue
      if now >= until:
        return
      wake = min(until, self._due[0][0]) if self._due else until
      self._stop.wait(max(0.0, wake - now))

  def next_frame(self, last: int) -> tuple[int, bytes] | None:
    """Returns number and JPEG of a frame later than `last`, waiting a while; None if none came."""
    with self._arrived:
      self._arrived.wait_for(lambda: self._newest is not None and self._newest[0] > last, _WAIT)
      if self._newest is None or self._newest[0] <= last:
        return None
      return self._newest

  @property
  def closed(self) -> bool:
    """Whether the stream has ended, by `close` or by an error."""
    return self._stop.is_set() or self.error is not None

  def close(self) -> None:
    """Ends the stream and frees the port."""
    self._stop.set()
    if self._threads:
      self._server.shutdown()
    self._server.server_close()
    for thread in self._threads:
      thread.join(5.0)
    self._threads.clear()

  def __enter__(self) -> "CameraStream":
    self.start()
    return self

  def __exit__(self, *_: object) -> None:
    self.close()


class _Handler(BaseHTTPRequestHandler):
  """Answers /stream.mjpg and /controls."""

  camera: CameraStream
  protocol_version = "HTTP/1.0"

  def do_GET(self) -> None:
    path, _, query = self.path.partition("?")
    if path == "/stream.mjpg":
      self._send_stream()
    elif path == "/controls":
      self._answer_controls(query)
    else:
      self.send_error(404)

  def _answer_controls(self, query: str) -> None:
    try:
      values = {key: float(value) for key, value in urllib.parse.parse_qsl(query)}
    except ValueError:
      self.send_error(400, "controls are numbers")
      return
    self.camera.set_controls(values)
    body = json.dumps(self.camera.controls()).encode()
    self.send_response(200)
    self.send_header("Content-Type", "application/json")
    self.send_header("Content-Length", str(len(body)))
    self.end_headers()
    self.wfile.write(body)

  def _send_stream(self) -> None:
    self.send_response(200)
    self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
    self.send_header("Cache-Control", "no-cache")
    self.end_headers()
    last = -1
    try:
      while not self.camera.closed:
        frame = self.camera.next_frame(last)
        if frame is None:
          continue
        last, data = frame
        head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
        self.wfile.write(head.encode() + data + b"\r\n")
    except (BrokenPipeError, ConnectionResetError):
      pass  # the client has gone

  def log_message(self, format: str, *args: object) -> None:
    """Keeps the console quiet."""
