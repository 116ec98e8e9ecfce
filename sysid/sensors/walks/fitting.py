"""The effect that makes most of walks, of several, and how well its value is known.

Squares of figures are in the scatter of earlier walks. A walk counts by the logarithm of its mean
square, so that no single one decides; a value is told as well as it stays where a walk, or a
joint's figures, are left out (the jackknife of Quenouille 1956).

Shapes: K walks, D figures of a walk, V values.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from nerf2real.suite.effects import Effect
from nerf2real.sysid.sensors.walks.replay import TORSO

Array = np.ndarray

_RESOLVED = 3e-4  # rad, and rad/s: a mean of readings of an encoder is not known better
_REFINED = 4  # effects that are looked at closely, of those that leave least at first sight
_ASIDE = 0.15  # of its best value's distance from nothing at which each is simulated once more
_STEPS = 400  # of a value between nothing and the most


class Candidate(NamedTuple):
  """An effect of one value that walks may show."""

  kind: str
  target: str | None
  parameter: str
  nothing: float
  values: tuple[float, ...]  # that are simulated, from little to much
  named: bool = True  # False: another explanation, which is named elsewhere

  def effect(self, value: float) -> Effect:
    """Returns the effect at a value."""
    return Effect(self.kind, self.target, {self.parameter: value})


class Found(NamedTuple):
  """A candidate at the value that leaves least."""

  candidate: Candidate
  value: float
  left: Array  # [K] of each walk, at the value that leaves least of the others
  spread: float  # standard error of the value, of the jackknives over walks and over joints


class Judge:
  """What is left of walks, in the scatter of those of before."""

  def __init__(self, seen: Array, missed: Array):
    self._seen = seen
    self._expected, self._variance = _scatter(missed)
    left = []
    for k, walk in enumerate(missed):
      expected, variance = _scatter(np.delete(missed, k, axis=0))
      left.append(np.mean((walk - expected) ** 2 / variance))
    self.usual = float(np.mean(left))  # of a walk of before, in the scatter of the others
    joints = (missed.shape[1] - TORSO) // 2
    listed = [np.array([joint, joint + joints]) for joint in range(joints)]
    self.parts = [*listed, np.arange(2 * joints, missed.shape[1])]
    """Figures of each joint, and of the torso."""

  def squares(self, simulated: Array) -> Array:
    """Returns the squares of what is left of figures [..., K, D]."""
    return (self._seen - simulated - self._expected) ** 2 / self._variance

  def left(self, simulated: Array) -> Array:
    """Returns the mean square [K] that is left of each walk [K, D]."""
    return self.squares(simulated).mean(axis=-1)


def best_first(
  simulated: Callable[[Candidate, float], Array],
  listed: Sequence[Candidate],
  nothing: Array,
  judge: Judge,
) -> list[Found]:
  """Returns the candidates at their best values, the one that leaves least first.

  Args:
    simulated: returns the figures [K, D] with a candidate at a value.
    listed: to be tried.
    nothing: figures [K, D] without any.
    judge: of what is left.
  """
  courses = {c: {c.nothing: nothing} for c in listed}  # figures [K, D] by value

  def ranked() -> list[Found]:
    found = [_fitted(candidate, course, judge) for candidate, course in courses.items()]
    return sorted(found, key=lambda f: np.log1p(f.left).sum())

  def add(candidate: Candidate, *values: float) -> None:
    for value in values:
      if value not in courses[candidate] and value != candidate.nothing:
        courses[candidate][value] = simulated(candidate, value)

  for candidate in listed:
    add(candidate, candidate.values[1])
  nearest = [f.candidate for f in ranked()[:_REFINED]]
  for candidate in nearest:
    add(candidate, *candidate.values)
  for candidate, value, *_ in [f for f in ranked() if f.candidate in nearest]:
    away = value - candidate.nothing
    add(candidate, *(candidate.nothing + share * away for share in (1 - _ASIDE, 1 + _ASIDE)))
  return ranked()


def _scatter(missed: Array) -> tuple[Array, Array]:
  """Returns what is expected of a further walk, and its variance [D], from walks [K, D]."""
  variance = missed.var(axis=0, ddof=1) + _RESOLVED**2
  return missed.mean(axis=0), variance * (1 + 1 / len(missed))


def _fitted(candidate: Candidate, course: dict[float, Array], judge: Judge) -> Found:
  """Returns a candidate at the value that leaves least; figures between are interpolated."""
  nodes = np.array(sorted(course))
  figures = np.stack([course[value] for value in nodes])
  between = PchipInterpolator(nodes, figures)
  values = np.linspace(nodes[0], nodes[-1], _STEPS + 1)
  squares = judge.squares(between(values))
  left = squares.mean(axis=2)
  cost = np.log1p(left)  # of a walk's square, so that no single walk decides
  count = left.shape[1]
  others = np.argmin(cost.sum(axis=1, keepdims=True) - cost, axis=0)  # [K], without each
  parts = [np.delete(squares, part, axis=2).mean(axis=2) for part in judge.parts]
  partly = [np.argmin(np.log1p(part).sum(axis=1)) for part in parts]  # without each joint
  spread = np.hypot(_jackknife(values[others]), _jackknife(values[partly]))
  value = float(values[np.argmin(cost.sum(axis=1))])
  return Found(candidate, value, left[others, np.arange(count)], float(spread))


def _jackknife(values: Array) -> float:
  """Returns the standard error of a value from what it is without each part [N] (Quenouille)."""
  return float((len(values) - 1) / np.sqrt(len(values)) * np.std(values))


def apart(more: Array, less: Array) -> float:
  """Returns by how many standard errors the logarithms of squares [K] differ in the mean."""
  difference = np.log1p(more) - np.log1p(less)
  error = difference.std(ddof=1) / np.sqrt(len(difference))
  return float(difference.mean() / max(error, 1e-12))
