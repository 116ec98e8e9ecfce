"""How finely a declared model is simulated: until readings like its logs' could not tell.

A machine has no time step, and its dry friction does not creep. What a model's numerics add is lag,
the inertia of damping that acts at a step's end, and friction that yields. Constants within their
tolerances imitate most of that, so that a model is as good with it as without, until what they do
not imitate is more than the readings' noise: then a healthy machine would have effects that are
the simulation's. Logs that a simulation made may say themselves that they have its numerics.
Shapes: N samples of all logs, n constants.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import qr
from scipy.optimize import lsq_linear

from nerf2real.sysid.fit.noise import timing
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.hypotheses.free_force import free_force
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.measured import block_starts
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

_SHORTEST = 2.5e-4  # s, of a step that is looked for; chosen: what it costs grows with the steps
_WIDTH = 0.2  # of finite differences, of a constant's scale
_NONE = 1e-12  # of the noise, that nothing moves by
_SAME = 1e-3  # of its length, that a force's course is apart from the others' to be one more
_TO_NOTHING = 2.0  # times what halving a step changes: what a step of nothing would
_MACHINE = 0.5  # standard deviation of the share of a resolved simulation that logs show, about 1


def numerics(machine: Machine) -> Numerics:
  """Returns the numerics with which a declared model is simulated: its own, or finer ones.

  Args:
    machine: the declared model along the logs.
  """
  declared = Numerics(machine.reductions[0].step)
  seen = [_Seen(machine.joint(joint)) for joint in machine.moving()]
  held = declared._replace(prompt=True)
  found = held if any(s.differs(declared, held) for s in seen) else declared
  for s in seen:
    finer = found._replace(step=0.5 * found.step)
    while finer.step >= _SHORTEST and s.differs(found, finer, _TO_NOTHING):
      found, finer = finer, finer._replace(step=0.5 * finer.step)
  return found if found == declared or _shown(seen, found) else declared


class _Seen:
  """A joint and what its readings let pass."""

  def __init__(self, plant: JointModel):
    self.plant, self.own = plant, constants(plant)
    self.noise, _ = timing(plant)
    self.here, steps = self._run(plant), _WIDTH * np.array(self.own.scale)
    moved = [self._run(plant, x) - self.here for x in np.diag(steps)]
    self._moved = np.array(moved) / steps[:, None] / self.noise
    self._frame, self._slopes = np.linalg.qr(self._moved.T)
    self._tolerance = SETTINGS.sigmas * np.array(self.own.prior)
    lengths = [len(log.time) for log in plant.logs]
    self._ends = np.cumsum(lengths)[:-1]
    starts = [block_starts(log.time, SETTINGS.block_s) for log in plant.logs]
    self.starts = np.concatenate([s + e for s, e in zip(starts, [0, *self._ends], strict=True)])

  def course(self, numerics: Numerics) -> Array:
    """Returns positions [N] of the declared joint."""
    return self._run(self.plant.simulated_by(numerics))

  def _run(
    self, plant: JointModel, x: Array | None = None, terms: Sequence[Term] | None = None
  ) -> Array:
    """Returns positions [N] with constants, or what else is given, off by x."""
    x = np.zeros(len(self.own.names)) if x is None else x
    p, loads, _ = compose(plant, [self.own] if terms is None else terms, x)
    return np.concatenate([plant.run(p, loads, i).position for i in range(len(plant.logs))])

  def beyond(self, course: Array) -> Array:
    """Returns what of a difference of courses [N] no constants imitate that are within their
    tolerances, over the noise."""
    row = course / self.noise
    limits = -self._tolerance, self._tolerance
    left: Array = row - lsq_linear(self._slopes, row @ self._frame, limits).x @ self._moved
    return left

  def apart(self, courses: Sequence[Array]) -> list[Array]:
    """Returns what of differences of courses [N] neither constants nor a force of any form over
    position and velocity imitate, over the noise."""
    force = free_force(self.plant)
    terms, known = [self.own, force], np.zeros(len(self.own.names))
    moved = list(self._moved)
    for values in np.diag(_WIDTH * np.array(force.scale)):
      moved.append((self._run(self.plant, np.r_[known, values], terms) - self.here) / self.noise)
    rows = [row / max(float(np.linalg.norm(row)), _NONE) for row in moved]
    frame, lengths, _ = qr(np.array(rows).T, mode="economic", pivoting=True)
    frame = frame[:, np.abs(np.diag(lengths)) > _SAME]
    return [row - frame @ (frame.T @ row) for row in (course / self.noise for course in courses)]

  def differs(self, one: Numerics, other: Numerics, factor: float = 1.0) -> bool:
    """Tells whether two simulations differ by more than the noise, in the median log."""
    left = factor * self.beyond(self.course(other) - self.course(one))
    squares = [np.mean(np.square(part)) for part in np.split(left, self._ends)]
    return bool(np.median(squares) > 1.0)


def _shown(seen: Sequence[_Seen], finer: Numerics) -> bool:
  """Tells whether logs do not say that they have a declared model's own numerics.

  The share of the difference to finer ones that is in what the declared model leaves is 1 of a
  machine's logs and 0 of its own simulation's; blocks tell how sure it is. What the machine has
  that the model lacks is in these logs, too: a force of any form takes out most of it.
  """
  both, square = [], []  # of blocks
  for s in seen:
    read = np.concatenate([log.position for log in s.plant.logs])
    by, left = s.apart([s.course(finer) - s.here, read - s.here])
    both.append(np.add.reduceat(by * left, s.starts))
    square.append(np.add.reduceat(by * by, s.starts))
  b, q = np.concatenate(both), np.concatenate(square)
  share = b.sum() / q.sum()
  variance = np.sum((b - share * q) ** 2) / q.sum() ** 2
  weights = np.array([1.0 / _MACHINE**2, 1.0 / max(variance, 1e-12)])
  return bool(weights @ [1.0, share] > 0.5 * weights.sum())
