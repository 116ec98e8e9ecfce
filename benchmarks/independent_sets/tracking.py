"""The host of a torque-controlled arm: follows references by computed gravity and a PD law."""

import numpy as np

from benchmarks.independent_sets import bodies
from benchmarks.independent_sets.machine import Machine

Array = np.ndarray

BANDWIDTH = 14.0
"""rad/s; chosen: stable with readings or commands 20 ms late."""
DAMPING_RATIO = 0.8
_FILTER = 0.006  # s, of the differentiated readings


class Tracker:
  """Makes the torques [B, n] of each tick of a batch of hosts."""

  def __init__(self, nominal: Machine, references: Array, *, period: float):
    """Starts at rest on the references.

    Args:
      nominal: batch of declared models, [B, n].
      references: [C, B, n] rad.
      period: s between ticks.
    """
    self._nominal, self._references, self._period = nominal, references, period
    self._speeds = np.gradient(references, period, axis=0)
    inertia = _apparent(nominal)
    self._stiffness = inertia * BANDWIDTH**2
    self._damping = 2 * DAMPING_RATIO * BANDWIDTH * inertia
    self._most = nominal.nominal_constant * nominal.current_limit
    self._before = references[0]
    self._speed = np.zeros_like(references[0])

  def __call__(self, number: int, seen: Array) -> Array:
    """Returns the torques of tick `number` for encoder readings [B, n]."""
    share = self._period / (self._period + _FILTER)
    self._speed += share * ((seen - self._before) / self._period - self._speed)
    self._before = seen
    wanted = self._references[number]
    torque = self._stiffness * (wanted - seen) + bodies.weights(self._nominal, wanted)
    torque += self._damping * (self._speeds[number] - self._speed)
    return np.clip(torque, -self._most, self._most)


def _apparent(machine: Machine) -> Array:
  """Returns the inertia [B, 2] that each joint of a stretched arm has with the other one free."""
  outer, length = machine.inertia[:, 1], machine.length[:, 0]
  across = outer - length * machine.moment_z[:, 1]
  inner = machine.inertia[:, 0] + machine.mass[:, 1] * length**2 + 2 * across - outer
  first, second = inner + machine.rotor[:, 0], outer + machine.rotor[:, 1]
  spread = first * second - across**2
  return np.stack([spread / second, spread / first], axis=1)
