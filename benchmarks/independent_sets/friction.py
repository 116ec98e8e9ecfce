"""Presliding friction by parallel Maxwell-slip elements, with what the library of effects lacks.

Every element is a spring that slides at its share of the friction of steady motion, W(v); the sum
is hysteresis with memory of reversals in presliding and W(v) in gross motion. Source: Al-Bender,
Lampaert and Swevers 2005, The generalized Maxwell-slip model, IEEE Trans. Automatic Control 50(11),
with W reached at once (their attraction constant large). Friction that grows at rest follows the
ageing law of Dieterich 1979, J. Geophysical Research 84(B5): age' = 1 - |v| age / slip.

Shapes: B machines, n joints, E elements.
"""

import numpy as np

Array = np.ndarray

SHARES = np.array([0.1, 0.2, 0.3, 0.4])
"""Of W by element; chosen: the stiffness falls gradually as elements begin to slide."""
REACHES = np.array([0.15, 0.35, 0.65, 1.0])
"""Deflection at which each element slides, over the presliding distance."""
_RENEWAL = 3.0  # slip that renews a contact, in presliding distances (chosen: of that order)


class Friction:
  """Friction of a batch of joints, advanced by displacements."""

  def __init__(self, machine):
    self._machine = machine
    self.force = np.zeros((len(SHARES), *machine.coulomb.shape))
    """[E, B, n] N m or N."""
    reach = REACHES[:, None, None] * machine.presliding
    self._stiffness = SHARES[:, None, None] * machine.coulomb / reach
    self._age = np.zeros(machine.coulomb.shape)  # s, of the contact
    grown = 1 + machine.dwell_friction / np.maximum(machine.coulomb, 1e-12)
    self._slip = _RENEWAL * machine.presliding * grown
    self._aged = bool(np.any(machine.dwell_friction > 0))
    self._patched = bool(np.any(machine.patch_depth > 0))

  def steady(self, q: Array, v: Array) -> Array:
    """Returns the friction of steady motion [B, n], without its sign."""
    m = self._machine
    speed = np.abs(v)
    total = m.coulomb * (1 + m.fall * np.exp(-speed / m.fall_speed))
    total += m.stribeck * np.exp(-np.square(speed / m.stribeck_speed))
    if self._patched:
      total *= 1 + m.patch_depth * np.exp(-np.square((q - m.patch_place) / m.patch_width))
    if self._aged:
      total += m.dwell_friction * (1 - np.exp(-self._age / m.dwell_time))
    return total

  def ahead(self, move: Array, limit: Array) -> Array:
    """Returns the force of each element [E, B, n] after a displacement [B, n] from now on."""
    most = SHARES[:, None, None] * limit
    return np.minimum(np.maximum(self.force + self._stiffness * move, -most), most)

  def advance(self, move: Array, limit: Array, *, step: float) -> None:
    """Moves all elements by a displacement within a step [s]."""
    self.force = self.ahead(move, limit)
    if self._aged:
      self._age = (self._age + step) / (1 + np.abs(move) / self._slip)
