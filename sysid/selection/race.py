"""The race: every candidate is fitted beside the calibrated constants; the error ranks.

Scores are in nats of error: the mean over logs of log rms, in noise units, and what each fitted
value costs. A candidate that halves the error gains 0.69. Positions count in full, efforts at a
fraction. Thousands of readings for a handful of values: errors on blocks that were left out
(`held_out`) are the same to a few hundredths, so the many are ranked on what they were fitted to;
what is to be named must gain on left-out blocks, too (`joint`).

Shapes: N samples of a log.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.fitting import Fit, Problem
from nerf2real.sysid.hypotheses.terms import Term

Array = np.ndarray

FLOOR = 0.3  # noise variances added to a mean square before the logarithm; ours
EFFORT_SHARE = 0.3  # of the score, where efforts are measured; ours
PER_PARAMETER = 0.01  # nats that a parameter must earn; ours
PER_BOUND = 0.1  # nats that an effect pays for a value on its bound: a sign of a wrong kind; ours
PER_DEVIATION = 0.006  # nats a squared standard deviation of a declared constant's error; ours
CLOCKS = ("skew", "latency")  # values of a calibration that are no constants of the model
TRIMMED = 0.01  # share of the largest errors that a score leaves out: stale reads, command edges
BLOCK_S = 1.0  # s; blocks of cross-validation: several times the memory of a servo
_FIRST, _SECOND, _LAST = 3, 5, 30  # evaluations of a race's rounds
_PROMISING = 8  # candidates at least in the second round
_WITHIN = 0.3  # nats of the best in which all are


@dataclasses.dataclass(frozen=True)
class Entry:
  """A hypothesis in the race."""

  fit: Fit
  score: float
  """nats, penalty included; lower is better."""
  levels: Array
  """[logs, channels] rms in noise units."""

  @property
  def kind(self) -> str:
    """The kind of the last term."""
    return self.fit.terms[-1].kind

  @property
  def target(self) -> str | None:
    """The target of the last term."""
    return self.fit.terms[-1].target


def levels(problem: Problem, fit: Fit, masks: Sequence[Array] | None = None) -> Array:
  """Returns the trimmed rms [logs, channels] in noise units, on part of the samples."""
  masks = problem.masks if masks is None else masks
  rows = []
  for mask, channels in zip(
    masks, problem.errors(problem.simulate(fit.terms, fit.x)[0]), strict=True
  ):
    rows.append([_trimmed_rms(c[mask]) for c in channels if c is not None])
  return np.array(rows)


def _trimmed_rms(values: Array) -> float:
  squares = np.sort(np.square(values))
  keep = max(1, int(len(squares) * (1.0 - TRIMMED)))
  return float(np.sqrt(np.mean(squares[:keep])))


def score_of(table: Array, count: int) -> float:
  """Returns the score of levels [logs, channels] with `count` fitted values beside the constants.

  The mean over logs of 0.5 log(FLOOR + level^2).
  """
  logs = 0.5 * np.log(FLOOR + table**2)
  weight = np.array([1.0, EFFORT_SHARE])[: table.shape[1]]
  return float((logs @ weight).mean()) + PER_PARAMETER * count


def entry(problem: Problem, fit: Fit) -> Entry:
  """Scores a fit on the samples that it was fitted to."""
  table = levels(problem, fit)
  count = sum(len(t.names) for t in fit.terms if t.kind != "calibration")
  bounds = sum(fit.at_bound(t.kind) for t in fit.terms if t.kind != "calibration")
  return Entry(fit, score_of(table, count) + deviation(fit) + PER_BOUND * bounds, table)


def deviation(fit: Fit) -> float:
  """Returns what a fit pays for constants that are far from where they are expected, nats."""
  total = 0.0
  for index, term in enumerate(fit.terms):
    if term.kind == "calibration" and term.prior:
      centre = np.array(term.centre) if term.centre else 0.0
      off = (fit.part(index) - centre) / np.array(term.prior)
      total += float(sum(o**2 for o, n in zip(off, term.names, strict=True) if n not in CLOCKS))
  return PER_DEVIATION * total


def folds(problem: Problem, *, count: int = 2) -> list[tuple[list[Array], list[Array]]]:
  """Returns (fitted, held) masks: blocks of time dealt out in turn."""
  result = []
  for fold in range(count):
    held, fitted = [], []
    for log, mask in zip(problem.plant.logs, problem.masks, strict=True):
      block = np.floor((log.time - log.time[0]) / BLOCK_S).astype(int) % count
      held.append(mask & (block == fold))
      fitted.append(mask & (block != fold))
    result.append((fitted, held))
  return result


def folds_by_log(problem: Problem) -> list[tuple[list[Array], list[Array]]]:
  """Returns (fitted, held) masks: each log left out in turn, blocks of time where there is one."""
  masks = problem.masks
  if len(masks) == 1:
    return folds(problem)
  nothing = [np.zeros_like(m) for m in masks]
  result = []
  for left in range(len(masks)):
    fitted = [n if i == left else m for i, (m, n) in enumerate(zip(masks, nothing, strict=True))]
    held = [m if i == left else n for i, (m, n) in enumerate(zip(masks, nothing, strict=True))]
    result.append((fitted, held))
  return result


def held_out(problem: Problem, found: Entry, *, evaluations: int = 5) -> Entry:
  """Returns the entry with its score by blocked cross-validation."""
  tables = []
  for fitted, held in folds(problem):
    fit = problem.masked(fitted).fit(found.fit.terms, found.fit.x, evaluations=evaluations)
    tables.append(levels(problem, fit, held))
  table = np.sqrt(np.mean(np.square(tables), axis=0))
  count = sum(len(t.names) for t in found.fit.terms if t.kind != "calibration")
  return Entry(found.fit, score_of(table, count) + deviation(found.fit), table)


def run(
  problem: Problem,
  base: Sequence[Term],
  candidates: Sequence[Term],
  *,
  start: Array | None = None,
  finalists: int = 6,
) -> list[Entry]:
  """Fits every candidate on top of `base` and returns them, the best first.

  All get a few steps from every start, the better ones some more, those near the best are fitted to
  the end.

  Args:
    problem: the joint.
    base: terms that every hypothesis has (calibration, effects found before).
    candidates: one is added at a time.
    start: values of `base` to try beside its own starts [n].
    finalists: how many are fitted to the end.
  """
  base = tuple(base)
  if start is not None:
    base = tuple(_with_start(base, start))
  found = [entry(problem, problem.fit((*base, c), evaluations=_FIRST)) for c in candidates]
  found.sort(key=lambda e: e.score)
  for rank, e in enumerate(list(found)):
    if rank < _PROMISING or e.score < found[0].score + _WITHIN:
      found[rank] = _continued(problem, e, _SECOND)
  found.sort(key=lambda e: e.score)
  for rank, e in enumerate(found[:finalists]):
    if e.score < found[0].score + 1.0:
      found[rank] = _continued(problem, e, _LAST)
  return sorted(found, key=lambda e: e.score)


def _continued(problem: Problem, found: Entry, evaluations: int) -> Entry:
  """Returns an entry whose fit goes on from where it is."""
  fit = problem.fit(found.fit.terms, found.fit.x, evaluations=evaluations)
  return entry(problem, fit) if fit.cost < found.fit.cost else found


def _with_start(base: Sequence[Term], start: Array) -> list[Term]:
  """Returns the terms with the given values as their only start, calibrations with both."""
  result, at = [], 0
  for term in base:
    part = tuple(float(v) for v in start[at : at + len(term.names)])
    at += len(term.names)
    starts = (part, *term.starts) if term.kind == "calibration" else (part,)
    result.append(dataclasses.replace(term, starts=starts))
  return result


def above_floor(found: Entry) -> float:
  """Returns by how much an entry's positions lie above the noise: mean log rms over logs, nats."""
  return float(np.mean(0.5 * np.log(FLOOR + found.levels[:, 0] ** 2)) - 0.5 * np.log(FLOOR + 1.0))


def worst_log(found: Entry) -> float:
  """Returns by how much an entry's positions lie above the noise in the log it fits least, nats."""
  worst = float(np.max(found.levels[:, 0]))
  return float(0.5 * np.log((FLOOR + worst**2) / (FLOOR + 1.0)))
