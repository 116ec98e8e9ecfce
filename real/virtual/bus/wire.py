"""The cable: a pseudo-terminal whose other end is answered by the virtual devices.

The host opens `port` like any serial port. In real time a thread answers when the last bit of an
answer would be through the wire; with a `SteppedClock` the answer is there when a write returns,
and the clock stands at the time at which it would have come; `protocol_rehearsal` does that faster.
"""

import contextlib
import os
import select
import threading
import tty

from nerf2real.real.clock import Clock, SteppedClock, prefer_this_thread
from nerf2real.real.virtual.bus.devices import Devices
from nerf2real.real.virtual.bus.line import Line

_CHUNK = 4096
_MAX_LAG = 0.2  # s that the body may be behind the clock
_IDLE = 0.001  # s after which the body is brought up to date without packets


class Wire:
  """Connects devices to a pseudo-terminal."""

  def __init__(self, devices: Devices, clock: Clock):
    """Opens the pseudo-terminal and begins to answer.

    Args:
      devices: Who answers.
      clock: A `RealClock`, or the host's own `SteppedClock`.
    """
    self._devices, self._clock = devices, clock
    self._master, self._slave = os.openpty()
    for end in (self._master, self._slave):
      tty.setraw(end)
    self.port = os.ttyname(self._slave)
    """Path of the serial port."""
    self._line = Line(devices, clock)
    self._stop = threading.Event()
    self.error: Exception | None = None  # what ended the answering, if anything did
    self._thread: threading.Thread | None = None
    if isinstance(clock, SteppedClock):
      os.set_blocking(self._master, False)
      clock.answer = self._pump
    else:
      self._thread = threading.Thread(target=self._run, name="virtual wire", daemon=True)
      self._thread.start()

  def close(self) -> None:
    """Ends the answering and removes the port."""
    self._stop.set()
    if self._thread is not None:
      self._thread.join()
    elif isinstance(self._clock, SteppedClock):
      self._clock.answer = lambda: None
    for end in (self._master, self._slave):
      with contextlib.suppress(OSError):
        os.close(end)

  def _run(self) -> None:
    try:
      self._answer_until_stopped()
    except Exception as error:  # whatever physics or port raise: the robot's user is told of it
      self.error = error

  def _answer_until_stopped(self) -> None:
    clock = self._clock
    prefer_this_thread()  # servos do not wait for the host's programs
    while not self._stop.is_set():
      ready, _, _ = select.select((self._master,), (), (), _IDLE)
      # A machine too slow for the body must not fall behind for ever.
      self._devices.body.skip(clock.now() - _MAX_LAG)
      if not ready:
        self._devices.body.advance(clock.now())
        continue
      for answer in self._line.receive(os.read(self._master, _CHUNK)):
        clock.sleep_until(answer.time)
        os.write(self._master, answer.data)

  def _pump(self) -> None:
    assert isinstance(self._clock, SteppedClock)
    try:
      data = os.read(self._master, _CHUNK)
    except BlockingIOError:
      return
    for answer in self._line.receive(data):
      os.write(self._master, answer.data)
      self._clock.advance(answer.time)
    self._clock.advance(self._line.free)
