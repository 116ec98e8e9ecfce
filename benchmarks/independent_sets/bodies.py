"""Equations of motion of a carriage and of a planar chain of one or two links.

Shapes: B machines, n joints; constants are [B, n] or [B, 1], as `machine.Machine` has them.

A link turns about +y; a point (x, z) of it is at (x cos a + z sin a, -x sin a + z cos a) in the
world when the link stands at the absolute angle a. The equations of the chain are Lagrange's for
V = m g Z of every mass (e.g. Spong, Hutchinson and Vidyasagar 2006, section 7.3, for two links).
"""

import numpy as np

Array = np.ndarray


def carriage(machine, q: Array, v: Array, force: Array) -> Array:
  """Returns the acceleration [B, 1] m/s^2 of a mass on an inclined axis."""
  weight = machine.mass * machine.gravity * np.sin(machine.tilt)
  return (force - weight) / machine.mass


def chain(machine, q: Array, v: Array, force: Array) -> Array:
  """Returns the accelerations [B, n] rad/s^2 of a chain of one or two hinges."""
  if q.shape[1] == 1:
    return (force - weights(machine, q)) / machine.inertia
  second = q[:, 1]
  sine, cosine = np.sin(second), np.cos(second)
  length, x, z = machine.length[:, 0], machine.moment_x[:, 1], machine.moment_z[:, 1]
  coupling = length * (x * sine - z * cosine)
  slope = length * (x * cosine + z * sine)
  outer = machine.inertia[:, 1]
  across = outer + coupling
  inner = machine.inertia[:, 0] + machine.mass[:, 1] * length**2 + across + coupling
  load = force - weights(machine, q)
  first, last = v[:, 0], v[:, 1]
  one = load[:, 0] - slope * (2 * first + last) * last
  two = load[:, 1] + slope * first * first
  scale = 1.0 / (inner * outer - across * across)
  return np.stack([outer * one - across * two, inner * two - across * one], axis=1) * scale[:, None]


def weights(machine, q: Array) -> Array:
  """Returns the torque [B, n] that holds the links against gravity."""
  angles = np.cumsum(q, axis=1) + machine.tilt
  sine, cosine = np.sin(angles), np.cos(angles)
  each = -machine.gravity * (machine.moment_x * cosine + machine.moment_z * sine)
  if q.shape[1] == 2:
    each[:, 0] += machine.gravity[:, 0] * machine.mass[:, 1] * machine.length[:, 0] * sine[:, 0]
    each[:, 0] += each[:, 1]
  return each
