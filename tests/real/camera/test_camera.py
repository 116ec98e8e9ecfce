"""The camera on the virtual stream, on a film and on a made-up device driver."""

import time
import urllib.request

import cv2
import numpy as np
import pytest

from nerf2real.real.camera import device as cameras
from nerf2real.real.camera.device import CaptureSettings
from nerf2real.real.camera.source import check_shape, resize
from nerf2real.real.virtual.camera import Sensor, VirtualCamera
from nerf2real.real.virtual.stream import CameraStream

SIZE = (30, 40)


class Counter:
  """Pictures whose grey tells when they were taken: 10 levels every 0.1 s."""

  def __init__(self, shape=(60, 80)):
    self.begin, self.shape = time.monotonic(), shape

  def level(self, moment=None):
    return 20 + int(((moment or time.monotonic()) - self.begin) * 100)

  def __call__(self):
    return np.full((*self.shape, 3), min(self.level(), 250), np.uint8)


def test_newest_frame_and_its_age_from_the_stream():
  scene = Counter()
  with (
    CameraStream(scene, VirtualCamera(rate=40, latency=0.05, noise=0)) as stream,
    cameras.Camera.open(stream.url) as camera,
  ):
    time.sleep(0.6)  # a queue would hold two dozen frames now
    picture, age = camera.read()
    now = time.monotonic()
    assert picture.shape == (60, 80, 3) and picture.dtype == np.uint8
    assert resize(picture, SIZE).shape == (*SIZE, 3)
    shown = (float(picture[..., 1].mean()) - 20) / 100 + scene.begin  # when it was taken
    assert 0.04 < now - shown < 0.35  # latency, a period or two, decoding
    # The age leaves out the 0.05 s before a frame is sent, which nobody can see from here.
    assert 0 <= age <= now - shown
    stream.freeze(True)
    time.sleep(0.5)
    assert camera.read()[1] > 0.35


def test_stated_latency_is_part_of_the_age():
  with (
    CameraStream(Counter(), VirtualCamera(rate=40, latency=0)) as stream,
    cameras.Camera.open(stream.url, settings=CaptureSettings(latency=5.0)) as camera,
  ):
    assert 5.0 <= camera.read()[1] < 6.0


def test_colours_are_rgb_and_pixels_are_means():
  checks = np.zeros((60, 80, 3), np.uint8)
  checks[..., 0] = np.where(np.indices((60, 80)).sum(0) % 2, 200, 100)  # red
  with (
    CameraStream(lambda: checks, VirtualCamera(rate=30, latency=0.03, noise=0)) as stream,
    cameras.Camera.open(stream.url) as camera,
  ):
    red, green, blue = np.moveaxis(resize(camera.read()[0], SIZE).astype(float), -1, 0)
  assert red == pytest.approx(150, abs=20) and red.mean() == pytest.approx(150, abs=12)
  assert green.mean() < 40 and blue.mean() < 40


def test_controls_are_set_and_read_back(caplog):
  grey = np.full((60, 80, 3), 100, np.uint8)
  held = cameras.Controls(gain=50, exposure=1)
  with (
    CameraStream(lambda: grey, VirtualCamera(rate=40, latency=0.03, noise=0)) as stream,
    cameras.Camera.open(stream.url, settings=CaptureSettings(controls=held)) as camera,
  ):
    assert {k: v.holds for k, v in camera.readback.items()} == {"gain": True, "exposure": True}
    neutral = camera.read()[0].mean()
    camera.set_controls(cameras.Controls(gain=100))
    time.sleep(0.4)
    assert camera.read()[0].mean() / neutral == pytest.approx(2 ** (1 / 2.2), rel=0.03)
    assert stream.controls()["gain"] == pytest.approx(100)
    assert not caplog.records
    found = camera.set_controls(cameras.Controls(gain=400, white_balance=4000))
    assert found["gain"].found == pytest.approx(255) and not found["gain"].holds
    assert found["white_balance"].found is None
    assert "asked for 400, found 255" in caplog.text and "no such control" in caplog.text


def test_stream_that_is_lost_and_comes_back():
  stream = CameraStream(Counter())
  stream.start()
  camera = cameras.Camera.open(stream.url)
  try:
    port = int(stream.url.split(":")[2].split("/")[0])
    stream.close()
    time.sleep(0.8)
    assert camera.read()[1] > 0.6
    with CameraStream(Counter(), port=port):
      deadline = time.monotonic() + 60
      while time.monotonic() < deadline and camera.reopened == 0:
        time.sleep(0.05)
      time.sleep(0.3)
      assert camera.reopened >= 1 and camera.read()[1] < 0.3
  finally:
    camera.close()


def test_film_plays_at_its_own_rate(tmp_path):
  path = tmp_path / "film.avi"
  film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (80, 60))
  for level in range(40):
    film.write(np.full((60, 80, 3), 6 * level, np.uint8))
  film.release()
  with cameras.Camera.open(path) as camera:
    first = camera.read()[0].mean() / 6
    time.sleep(1.0)
    later = camera.read()[0].mean() / 6
    assert later - first == pytest.approx(20, abs=4)
    time.sleep(1.4)  # it has ended
    picture, age = camera.read()
    assert picture.mean() / 6 == pytest.approx(39, abs=1) and age > 0.2


class Driver:
  """A device that rounds its gain, refuses white balance and stamps its pictures."""

  def __init__(self, source):
    self.values = {cv2.CAP_PROP_GAIN: 0.0, cv2.CAP_PROP_EXPOSURE: 3.0}
    self.log = []

  def isOpened(self):
    return True

  def set(self, control, value):
    self.log.append((control, value))
    if control == cv2.CAP_PROP_GAIN:
      value = 8 * round(value / 8)
    self.values[control] = value
    return control != cv2.CAP_PROP_AUTO_WB

  def get(self, control):
    if control == cv2.CAP_PROP_POS_MSEC:
      return 1000 * (time.monotonic() - 0.2)
    return self.values.get(control, 0.0)

  def read(self):
    time.sleep(0.01)
    return True, np.full((480, 640, 3), 7, np.uint8)

  def release(self):
    pass


def test_device_controls_and_the_drivers_stamps():
  controls = cameras.Controls(gain=50, exposure=156, white_balance=4000)
  settings = CaptureSettings(capture_size=(480, 640), controls=controls)
  with cameras.Camera.open(0, settings=settings, capture=Driver) as camera:
    assert camera.readback["gain"] == cameras.Readback(50, 48.0)
    assert not camera.readback["gain"].holds and camera.readback["exposure"].holds
    assert camera.readback["white_balance"].found is None
    switches = dict(camera._capture.log)
    assert switches[cv2.CAP_PROP_AUTO_EXPOSURE] == 1 and switches[cv2.CAP_PROP_FRAME_WIDTH] == 640
    assert 0.2 <= camera.read()[1] < 0.4


@pytest.mark.parametrize("name", ["7", "/dev/video7", "link"])
def test_a_device_is_one_by_whatever_name(tmp_path, name):
  link = tmp_path / "usb-Logitech-index0"
  link.symlink_to("/dev/video7")
  with cameras.Camera.open(str(link) if name == "link" else name, capture=Driver) as camera:
    assert camera.source == 7
    assert camera.read()[1] >= 0.2  # by the driver's stamp


def test_errors_say_what_to_do(tmp_path):
  with pytest.raises(ValueError, match="Found no .*nowhere.mp4"):
    cameras.Camera.open(tmp_path / "nowhere.mp4")
  picture = Driver(0).read()[1]
  check_shape(picture, SIZE)
  with pytest.raises(ValueError, match="height, width"):
    check_shape(picture, (0, 40))
  with pytest.raises(ValueError, match="640 x 480 pixels, which do not shrink to 40 x 20"):
    check_shape(picture, (20, 40))
  with pytest.raises(cameras.CameraLostError, match="No picture came"):
    cameras.Camera.open("http://127.0.0.1:9/x.mjpg", settings=CaptureSettings(timeout=0.4))


def test_sensor_response_and_noise():
  grey = np.full((200, 200, 3), 128, np.uint8)
  quiet = Sensor(VirtualCamera(gain=1, exposure=1, noise=0)).develop(grey)
  assert quiet[0, 0, 1] == 128 and quiet[0, 0, 0] > 128 > quiet[0, 0, 2]
  doubled = Sensor(VirtualCamera(gain=1, exposure=2, noise=0)).develop(grey)[0, 0, 1]
  assert doubled == round(128 * 2 ** (1 / 2.2))
  assert (Sensor(VirtualCamera(gain=10, exposure=1, noise=0)).develop(grey) == 255).all()
  noisy = Sensor(VirtualCamera(gain=1, exposure=1, noise=3)).develop(grey)[..., 1].astype(float)
  assert noisy.std() == pytest.approx(3, rel=0.1) and noisy.mean() == pytest.approx(128, abs=0.3)
  amplified = (
    Sensor(VirtualCamera(gain=1.5, exposure=0.5, noise=3)).develop(grey)[..., 1].astype(float)
  )
  assert amplified.std() > noisy.std()


def test_stream_answers_and_frees_its_port():
  stream = CameraStream(Counter())
  stream.start()
  base = stream.url.rsplit("/", 1)[0]
  with pytest.raises(urllib.error.HTTPError, match="404"):
    urllib.request.urlopen(f"{base}/other")
  with pytest.raises(urllib.error.HTTPError, match="400"):
    urllib.request.urlopen(f"{base}/controls?gain=high")
  stream.close()
  again = CameraStream(Counter(), port=int(base.rsplit(":", 1)[1]))
  again.close()


def test_a_stream_whose_pictures_end_says_so_and_hangs_up():
  pictures = iter([np.zeros((60, 80, 3), np.uint8)] * 3)
  with CameraStream(lambda: next(pictures), VirtualCamera(rate=40, latency=0)) as stream:
    with urllib.request.urlopen(stream.url, timeout=10) as connection:
      assert connection.read().endswith(b"\r\n")  # to its end
    assert isinstance(stream.error, StopIteration) and stream.closed
