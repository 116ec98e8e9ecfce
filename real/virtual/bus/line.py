"""The half-duplex line between host and devices: what it carries takes its time."""

from collections.abc import Iterator

from nerf2real.real.clock import Clock
from nerf2real.real.virtual.bus.devices import BYTE_TIME, Answer, Devices
from nerf2real.real.virtual.bus.protocol import Parser


class Line:
  """Carries instructions to the devices and their answers back."""

  def __init__(self, devices: Devices, clock: Clock):
    """Takes who answers, and the time."""
    self._devices, self._clock = devices, clock
    self._parser = Parser()
    self.free = clock.now()  # s, when the line has carried everything that was sent

  def receive(self, data: bytes) -> Iterator[Answer]:
    """Yields the answers to bytes that the host wrote just now."""
    start = max(self.free, self._clock.now())
    self.free = start + len(data) * BYTE_TIME
    for packet in self._parser.feed(self._devices.hears(data)):
      start += packet.size * BYTE_TIME
      answers = self._devices.handle(packet, start)
      if answers:
        self.free = max(self.free, answers[-1].time)
      yield from answers
