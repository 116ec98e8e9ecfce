"""Records what the robot did and saw as MCAP, in a process of its own.

The control loop only puts readings into a queue; a thread passes them through a pipe to
`real.recorder.process`, which builds the messages, encodes pictures, packs and writes. The loop
never waits for a disk: if the recorder falls behind by more than the queue holds, readings are
dropped and counted.

If the control process dies, the recorder sees the pipe end and closes the file properly. If the
recorder is killed, the file lacks its footer but holds every chunk until then, a quarter of a
second at most before the end; `core.robot_logs.streaming` and other streaming readers read it.
"""

import contextlib
import logging
import pickle
import queue
import struct
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.robot_logs import messages, streaming

LENGTH = struct.Struct("<I")  # before every pickled message in the pipe
OPEN = "open"  # the other process's word once the file is there
_QUEUE = 2000  # readings: about four seconds at full rates
_START_TIMEOUT = 20.0  # s for the other process to import and open the file
_CLOSE_TIMEOUT = 20.0  # s for it to write what is left
_log = logging.getLogger(__name__)

Call = tuple[str, float, tuple[Any, ...], dict[str, Any]]
"""A message to build: name in `real.recorder.process.BUILDERS`, time [s], arguments."""


class Recorder:
  """Writes one log. All times are seconds since 1970, as `time.time()` gives them."""

  def __init__(self, path: Path | str):
    """Starts the recorder's process.

    Args:
      path: The MCAP file; its folder is made.

    Raises:
      OSError: The file cannot be written; the message holds the reason.
    """
    self.path = Path(path)
    above = (self.path.parent, *self.path.parent.parents)
    self._made = [folder for folder in above if not folder.exists()]
    self.path.parent.mkdir(parents=True, exist_ok=True)
    # A session of its own: Ctrl-C at the terminal ends the control loop, which then closes this.
    self._process = subprocess.Popen(
      [sys.executable, "-m", "nerf2real.real.recorder.process", str(self.path)],
      stdin=subprocess.PIPE,
      stdout=subprocess.PIPE,
      start_new_session=True,
    )
    self._wait_until_open()
    self._queue: queue.Queue[tuple[Call, ...] | None] = queue.Queue(_QUEUE)
    self.failure = ""  # why the file is not whole, known once it is closed
    self.dropped = 0  # readings that found the queue full or the process gone
    self.empty = True  # nothing has been noted
    self._closed = False
    self._sender = threading.Thread(target=self._send, daemon=True, name="recorder")
    self._sender.start()

  def _wait_until_open(self) -> None:
    answer: list[bytes] = []
    assert self._process.stdout is not None
    reader = threading.Thread(
      target=lambda: answer.append(self._process.stdout.readline()),  # type: ignore[union-attr]
      daemon=True,
    )
    reader.start()
    reader.join(_START_TIMEOUT)
    text = answer[0].decode().strip() if answer else f"no answer in {_START_TIMEOUT:g} s"
    if text != OPEN:
      self._process.kill()
      self._process.wait()
      raise OSError(f"The recorder cannot write {self.path}: {text or 'it ended at once'}.")

  @property
  def pid(self) -> int:
    """The recorder's process."""
    return self._process.pid

  @property
  def alive(self) -> bool:
    """Whether the recorder's process runs."""
    return self._process.poll() is None

  def _put(self, *calls: Call) -> None:
    self.empty = False
    if self._closed or not self.alive:
      self.dropped += 1
      return
    try:
      self._queue.put_nowait(calls)
    except queue.Full:
      self.dropped += 1

  def command(self, t: float, names: Sequence[str], positions: Sequence[float]) -> None:
    """Notes position targets [J] [rad]."""
    self._put(_joint_state(messages.COMMANDS, t, names, position=positions))

  def joints(
    self,
    t: float,
    names: Sequence[str],
    positions: Sequence[float],
    velocities: Sequence[float],
    currents: Sequence[float],
    voltages: Sequence[float],
    pwm: Sequence[float],
    *,
    stamps: Sequence[float],
  ) -> None:
    """Notes one reading of the joints, J numbers each.

    Args:
      t: Of the reading.
      names: Of the joints.
      positions: rad.
      velocities: rad/s.
      currents: A.
      voltages: V.
      pwm: Measured duty, -1 to 1.
      stamps: When each joint was read, s since 1970.
    """
    # Not efforts: amperes, volts, shares and seconds travel in a JointState's effort, by topic.
    others: dict[str, Sequence[float] | np.ndarray] = {
      messages.CURRENTS: currents,
      messages.VOLTAGES: voltages,
      messages.PWM: pwm,
      messages.STAMPS: np.asarray(stamps) - t,
    }
    self._put(
      _joint_state(messages.STATES, t, names, position=positions, velocity=velocities),
      *(_joint_state(topic, t, names, effort=values) for topic, values in others.items()),
    )

  def imu(
    self,
    t: float,
    gyro: Sequence[float],
    accel: Sequence[float],
    gravity: Sequence[float],
  ) -> None:
    """Notes turning rates [rad/s], specific force [m/s^2] and the estimate of gravity, [3] each."""
    self._put(("imu", t, (_copy(gyro), _copy(accel)), {}), ("gravity", t, (_copy(gravity),), {}))

  def image(self, t: float, picture: np.ndarray) -> None:
    """Notes a picture, RGB uint8 [H, W, 3]."""
    self._put(("image", t, (np.array(picture, np.uint8),), {}))

  def camera_info(self, t: float, camera: Camera) -> None:
    """Notes the lens."""
    self._put(("camera_info", t, (camera,), {}))

  def battery(self, t: float, voltage: float) -> None:
    """Notes the supply's voltage [V]."""
    self._put(("battery", t, (float(voltage),), {}))

  def temperature(self, t: float, name: str, celsius: float) -> None:
    """Notes a servo's temperature [degrees Celsius]."""
    self._put(("temperature", t, (name, float(celsius)), {}))

  def _send(self) -> None:
    pipe = self._process.stdin
    assert pipe is not None
    while True:
      item = self._queue.get()
      if item is None:
        break
      data = pickle.dumps(item, protocol=pickle.HIGHEST_PROTOCOL)
      try:
        pipe.write(LENGTH.pack(len(data)) + data)
        if self._queue.empty():
          pipe.flush()
      except (OSError, ValueError):  # the process is gone; or `close` waited long enough for it
        self.dropped += 1 + self._queue.qsize()
        _log.error("The recorder of %s has died: the rest of the run is not recorded.", self.path)
        return

  def close(self) -> None:
    """Writes what is left and ends the process; safe to call twice."""
    if self._closed:
      return
    self._closed = True
    with contextlib.suppress(queue.Full):  # the process is gone or hangs: it is ended below
      self._queue.put(None, timeout=_CLOSE_TIMEOUT if self._sender.is_alive() else 0.01)
    self._sender.join(_CLOSE_TIMEOUT)
    with contextlib.suppress(OSError):  # the process is gone
      if self._process.stdin is not None:
        self._process.stdin.close()
    try:
      self._process.wait(_CLOSE_TIMEOUT)
    except subprocess.TimeoutExpired:
      _log.error("The recorder of %s hangs and is ended.", self.path)
      self._process.kill()
      self._process.wait()
    assert self._process.stdout is not None
    words = self._process.stdout.read().decode(errors="replace").strip()
    self._process.stdout.close()
    if self._process.returncode:
      self.failure = self._describe(words)
    if self.dropped:
      _log.warning("The recorder of %s dropped %d readings.", self.path, self.dropped)

  def abandon(self) -> None:
    """Ends the recording of a robot that was not reached: nothing is left of it."""
    self.close()
    self.path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # it holds something else by now
      for folder in self._made:
        folder.rmdir()

  def _describe(self, words: str) -> str:
    """Returns why the file is not whole; one that holds no message is removed."""
    try:
      held = next(iter(streaming.read_messages(self.path, recover=True)), None)
    except (OSError, ValueError):
      held = None
    if held is None:
      self.path.unlink(missing_ok=True)
      left = "Nothing was recorded."
    else:
      left = f"{self.path} holds what was recorded until then."
    return f"{words or f'The recorder of {self.path} was killed.'} {left}"

  def raise_failure(self) -> None:
    """Raises OSError if the file that was closed is not whole."""
    if self.failure:
      raise OSError(self.failure)

  def __enter__(self) -> "Recorder":
    return self

  def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
    self.close()
    if kind is None:
      self.raise_failure()


def _joint_state(
  topic: str, t: float, names: Sequence[str], **fields: Sequence[float] | np.ndarray
) -> Call:
  return "joint_state", t, (topic, tuple(names)), {k: _copy(v) for k, v in fields.items()}


def _copy(values: Sequence[float] | np.ndarray) -> np.ndarray:
  return np.array(values, np.float64)
