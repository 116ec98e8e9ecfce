"""The serial port of the DYNAMIXEL SDK, with waits that do not spin and time-outs of our own.

The SDK polls the port as fast as it can and gives up after 34 ms plus the time on the wire, four
bus cycles. Here a read sleeps until bytes come, and the time-out is what the caller sets for each
packet.
"""

import contextlib
import termios
from pathlib import Path

import dynamixel_sdk
import serial

from nerf2real.real.clock import Clock

_PATIENCE = 0.1  # s that an answer may be late outside the cycle
_GRACE = 0.005  # s after a time-out in which bytes that lie here are still taken
_TICK = 1e-6  # s beyond a time-out: the SDK ends a wait only when it has passed
_LATENCY_LIMIT = 1  # ms; the adapter's own default of 16 ms is a hidden delay


class PortError(OSError):
  """The serial port cannot be used; the message holds what to do."""


class Port(dynamixel_sdk.PortHandler):
  """A `dynamixel_sdk.PortHandler` on a `Clock`."""

  def __init__(self, path: str, *, baud: int, clock: Clock):
    """Opens the port.

    Args:
      path: Such as /dev/ttyUSB0, or a URL of pyserial.
      baud: Bit/s.
      clock: Time for time-outs.

    Raises:
      PortError: It cannot be opened, or its adapter holds bytes back.
    """
    super().__init__(path)
    self._clock = clock
    self.deadline: float | None = None  # s, no wait goes on after it
    self.byte_time = 10 / baud  # s
    self._last = float("-inf")  # s, when a wait ends whatever still comes
    try:
      opened = self.setBaudRate(baud)
    except (OSError, ValueError) as error:
      raise PortError(
        f"The serial port {path} cannot be opened ({error}): check the cable, the path, and that "
        "this user is in the group of the port (often `dialout`)."
      ) from error
    if not opened:
      raise PortError(f"The DYNAMIXEL SDK knows no {baud} bit/s: use 2000000, as the OP3 does.")
    _check_latency(path)

  def setupPort(self, cflag_baud: int) -> bool:
    # The SDK's own takes paths alone; pyserial's function opens URLs, too.
    self.ser = serial.serial_for_url(self.port_name, baudrate=self.baudrate, timeout=0)
    self.is_open = True
    self.clearPort()
    self.tx_time_per_byte = 1000 * self.byte_time
    return True

  def clearPort(self) -> None:
    # Of an adapter that was unplugged pyserial raises what is no OSError.
    try:
      super().clearPort()
    except termios.error as error:
      raise serial.SerialException(f"{self.port_name}: {error}") from error

  def getCurrentTime(self) -> float:
    return 1000 * self._clock.now()

  def setPacketTimeout(self, packet_length: int) -> None:
    # The SDK gives a rough upper bound of the length; `expect` sets the true one.
    self.setPacketTimeoutMillis(1000 * (packet_length * self.byte_time + _PATIENCE))

  def expect(self, size: int, *, delay: float, margin: float) -> None:
    """Sets the time-out for an answer; call it between sending and receiving.

    Args:
      size: Bytes on the wire from now on.
      delay: s in which the wire is silent.
      margin: s that the answer may be late before it counts as lost.
    """
    wait = delay + size * self.byte_time + margin
    if self.deadline is not None:
      wait = min(wait, self.deadline - self._clock.now())
    self.setPacketTimeoutMillis(1000 * max(wait, 0.0))

  def isPacketTimeout(self) -> bool:
    # An answer that lies here is not late, whatever kept this thread from taking it.
    if not super().isPacketTimeout():
      return False
    return self.ser.in_waiting == 0 or self._clock.now() >= self._last

  def setPacketTimeoutMillis(self, msec: float) -> None:
    super().setPacketTimeoutMillis(msec)
    last = self._clock.now() + msec / 1000 + _GRACE
    self._last = last if self.deadline is None else min(last, self.deadline)

  def readPort(self, length: int):
    # A line that never falls silent must not hold the thread that watches the robot: the SDK looks
    # at the time only when bytes are missing.
    if self._clock.now() >= self._last:
      return b""
    left = self.packet_timeout / 1000 - (self._clock.now() - self.packet_start_time / 1000)
    if length > 0 and self.ser.in_waiting < length:
      self._clock.wait_readable(self.ser.fd, max(left, 0.0) + _TICK)
    return super().readPort(length)

  def writePort(self, packet) -> int:
    written = super().writePort(bytes(packet))
    self._clock.settle()
    return written

  def close(self) -> None:
    """Closes the port."""
    if self.ser is not None:
      with contextlib.suppress(OSError):
        self.closePort()


def _check_latency(path: str) -> None:
  """Makes a USB adapter deliver bytes at once, or raises with the command for it."""
  timer = Path("/sys/bus/usb-serial/devices") / Path(path).name / "latency_timer"
  if not timer.exists():
    return
  if int(timer.read_text()) > _LATENCY_LIMIT:
    try:
      timer.write_text(str(_LATENCY_LIMIT))
    except OSError as error:
      raise PortError(
        f"The adapter of {path} holds bytes back for {timer.read_text().strip()} ms, and this user "
        f"may not change that: echo {_LATENCY_LIMIT} | sudo tee {timer}"
      ) from error
