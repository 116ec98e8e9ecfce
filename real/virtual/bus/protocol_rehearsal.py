"""The cable of a rehearsal in stepped time: a serial port in memory, as a pyserial class.

A pseudo-terminal hands every byte from one kernel thread to another; on a busy machine that costs a
rehearsal ten times what it computes. Here the same bytes go from buffer to buffer. pyserial opens
it by its name, `rehearsal://<number>`: `serial.serial_for_url` finds this module by its own.
"""

import itertools
import os
import weakref

import serial

from nerf2real.real.clock import SteppedClock
from nerf2real.real.virtual.bus.devices import Devices
from nerf2real.real.virtual.bus.line import Line

SCHEME = "rehearsal://"
serial.protocol_handler_packages.append(__package__)
_numbers = itertools.count(1)
_cables: "weakref.WeakValueDictionary[str, Cable]" = weakref.WeakValueDictionary()


class Cable:
  """Connects devices to a port of stepped time: answers are there when a write returns."""

  def __init__(self, devices: Devices, clock: SteppedClock):
    """Plugs the cable in.

    Args:
      devices: Who answers.
      clock: The host's own.
    """
    self.port = f"{SCHEME}{next(_numbers)}"
    """Name of the serial port."""
    self.sent, self.received = bytearray(), bytearray()  # by the host
    self._line, self._clock = Line(devices, clock), clock
    clock.answer = self._pump
    _cables[self.port] = self

  def close(self) -> None:
    """Unplugs it."""
    self._clock.answer = lambda: None
    _cables.pop(self.port, None)

  def _pump(self) -> None:
    if not self.sent:
      return
    data = bytes(self.sent)
    self.sent.clear()
    for answer in self._line.receive(data):
      self.received += answer.data
      self._clock.advance(answer.time)
    self._clock.advance(self._line.free)


class Serial(serial.SerialBase):
  """The host's end, as a pyserial class without time-outs (timeout=0)."""

  def open(self) -> None:
    """Opens the port.

    Raises:
      SerialException: There is no such cable, or it has been unplugged.
    """
    cable = _cables.get(self.portstr)
    if cable is None:
      raise serial.SerialException(f"no rehearsal is plugged in as {self.portstr}")
    self._cable = cable
    self.fd, self._silent_end = os.pipe()  # never readable: who waits for it waits in vain
    self.is_open = True

  def close(self) -> None:
    """Closes the port."""
    if self.is_open:
      self.is_open = False
      for end in (self.fd, self._silent_end):
        os.close(end)

  def _reconfigure_port(self) -> None:
    """Accepts any speed: the devices time the bytes."""

  @property
  def in_waiting(self) -> int:
    """Bytes that have come and were not read."""
    return len(self._cable.received)

  def read(self, size: int = 1) -> bytes:
    """Returns up to `size` bytes of those that are there."""
    found = bytes(self._cable.received[:size])
    del self._cable.received[:size]
    return found

  def write(self, data: bytes) -> int:
    """Sends bytes."""
    self._cable.sent += data
    return len(data)

  def reset_input_buffer(self) -> None:
    """Discards what has come."""
    self._cable.received.clear()
