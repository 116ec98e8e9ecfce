"""Motors and their controllers: what makes torque of a command.

A motor has a winding, R i + L di/dt = u - k w, and gives k i; k, w and all that is mechanical are
at the output, behind the gear. Three controllers, which run at ticks and read counts of encoders:

- "servo": duty in proportion to the position error; bridge with a dead band and a current limit;
- "cascade": position loop on the link's scale, velocity loop on the motor's encoder, current loop;
- "current": the command is a torque, the current loop follows.

The current loop cancels the winding's pole (R. Krishnan 2001, Electric Motor Drives, section 3.6),
so the current follows with one time constant as long as the supply's voltage allows.

Shapes: B machines, n joints.
"""

import numpy as np

Array = np.ndarray


class Drive:
  """Electric state of a batch of drives."""

  def __init__(self, machine, mode: str, *, step: float):
    self._machine, self._mode, self._step = machine, mode, step
    shape = machine.torque_constant.shape
    self.current = np.zeros(shape)
    """A."""
    self.duty = np.zeros(shape)
    self.volts = np.broadcast_to(machine.volts, shape).copy()
    """Of the supply, under load."""
    self._wanted = np.zeros(shape)  # A
    self._rate = np.zeros(shape)  # rad/s, filtered
    self._seen: Array | None = None

  def tick(self, command: Array, encoder: Array, rotor: Array, *, period: float) -> None:
    """Runs the controllers once.

    Args:
      command: [B, n] position or torque.
      encoder: [B, n] position as read.
      rotor: [B, n] position of the motor as read, at the output.
      period: s since the last tick.
    """
    m = self._machine
    if self._mode == "servo":
      duty = m.servo_gain * (command - encoder)
      self.duty = np.minimum(np.maximum(duty, -m.duty_limit), m.duty_limit)
      return
    if self._mode == "cascade":
      seen = rotor if self._seen is None else self._seen
      share = period / (m.rate_filter + period)
      self._rate += share * ((rotor - seen) / period - self._rate)
      self._seen = rotor
      command = m.velocity_gain * (m.position_gain * (command - encoder) - self._rate)
    wanted = command / m.nominal_constant
    self._wanted = np.minimum(np.maximum(wanted, -m.current_limit), m.current_limit)

  def advance(self, speed: Array, *, time: float) -> Array:
    """Advances the windings by one step and returns the torques [B, n]."""
    m, step = self._machine, self._step
    supply = m.volts * (1 - m.fade * max(time, 0.0))
    self.volts = supply - m.supply_resistance * np.abs(self.current)
    back = m.torque_constant * speed
    decay = np.exp(-m.resistance / m.inductance * step)
    if self._mode == "servo":
      size = np.abs(self.duty)
      lost = np.where(size > m.dead_band, np.sign(self.duty) * (size - m.dead_band), 0.0)
      volts = self.volts * lost / (1 - m.dead_band)
    else:
      change = m.inductance / m.current_time * (self._wanted - self.current)
      volts = m.resistance * self.current + back + change
      volts = np.minimum(np.maximum(volts, -self.volts), self.volts)
      self.duty = volts / self.volts
    final = (volts - back) / m.resistance
    before = self.current
    current = final + (before - final) * decay
    if self._mode == "servo":
      current = np.minimum(np.maximum(current, -m.current_limit), m.current_limit)
    self.current = current
    return m.torque_constant * 0.5 * (before + current)
