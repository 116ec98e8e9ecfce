"""A scored hypothesis of one joint, and how clear its evidence is of another's."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.stats import rankdata

from nerf2real.sysid.fit.layout import Fit
from nerf2real.sysid.hypotheses.terms import FREE, Term

Array = np.ndarray

UNREPEATED = ("backlash",)
"""Kinds under which a course does not repeat: which way teeth bounce depends on microradians."""

_NAT = 1.0  # that a further value costs (Akaike 1974): a smaller difference says nothing


@dataclasses.dataclass
class Scored:
  """A fitted hypothesis of one joint, with its evidence."""

  terms: tuple[Term, ...]
  fit: Fit
  nats: Array
  """[B] log-likelihood of the left-out blocks."""
  neutral: bool = False
  """Whether an effect stands at the values that do nothing: a rival, never an explanation."""

  @property
  def names(self) -> frozenset[str]:
    """Kinds of its effects."""
    return kinds_of(self.terms)

  @property
  def beside_force(self) -> bool:
    """Whether a force of any form is among its terms."""
    return any(t.kind == FREE for t in self.terms)

  def values(self, kind: str) -> dict[str, float]:
    """Returns the values of the term of a kind by name; empty if it has none."""
    term = next((t for t in self.terms if t.kind == kind), None)
    return {} if term is None else self.fit.values(term)

  @property
  def evidence(self) -> float:
    """Sum of the blocks' nats, less what the priors cost."""
    return float(self.nats.sum()) - self.prior

  @property
  def prior(self) -> float:
    """What the priors cost, nats: those of the values, and of the one of many forms that was
    chosen."""
    sigma, centre = self.fit.layout.sigma, self.fit.layout.centre
    chosen = float(np.sum(np.log([t.choices for t in self.terms])))
    return 0.5 * float(np.sum(((self.fit.x - centre) / sigma) ** 2)) + chosen


def kinds_of(terms: Sequence[Term]) -> frozenset[str]:
  """Returns the kinds of effects that are not the machine's anyway."""
  return frozenset(t.name for t in terms if t.name is not None)


def clear(better: Scored, other: Scored) -> float:
  """Returns how clear a difference of evidence is, in standard errors; see `clearness`."""
  return clearness([better.nats - other.nats], better.prior - other.prior)


def clearness(rows: Sequence[Array], prior: float) -> float:
  """Returns how clear a difference of two hypotheses is, in standard errors.

  The larger of two paired tests: of the sum over its standard error by blocks (Vuong 1989), and of
  the signed ranks of neighbouring pairs of blocks (Wilcoxon 1945), as one without a distribution is
  wanted where few blocks hold most of a sum (Clarke 2007): a motion excites an effect in some of
  them. Ranks know no size: pairs that differ by less than a nat, as an effect that imitates what no
  hypothesis holds makes them, agree with neither hypothesis.

  Args:
    rows: differences of nats of blocks, one array for each joint; joints are independent.
    prior: nats that the priors cost more.
  """
  total = float(sum(row.sum() for row in rows)) - prior
  error = float(np.sqrt(sum(variance(row) for row in rows)))
  by_sum = total / max(error, _NAT)
  pairs = np.concatenate([np.add.reduceat(row, np.arange(0, len(row), 2)) for row in rows])
  pairs = pairs - prior / len(pairs)
  ranks = rankdata(np.abs(pairs))
  agree = np.sign(pairs) * (np.abs(pairs) >= _NAT)
  return max(by_sum, float(agree @ ranks / np.sqrt(ranks @ ranks)))


def standardised(differences: Array, total: float | None = None, least: float = 1e-300) -> float:
  """Returns a sum of blocks' differences over its standard error."""
  total = float(differences.sum()) if total is None else total
  return total / max(np.sqrt(variance(differences)), least)


def variance(differences: Array) -> float:
  """Returns the variance of a sum of blocks' differences, of which neighbours may go together."""
  e = differences - differences.mean()
  own = float(e @ e)
  return max(own + 2.0 * float(e[1:] @ e[:-1]), own) * len(e) / max(len(e) - 1, 1)


def more_likely(differences: Array, prior: float, level: float) -> bool:
  """Tells whether logs as they are were left by a hypothesis and not by another: whether that is
  more likely by 1 / level, without the block that says so most.

  The standard error by blocks is for what other motions would show, and few blocks never tell.

  Args:
    differences: nats of the blocks of all logs, less the other's.
    prior: nats that the priors cost more.
    level: of significance.
  """
  return float(differences.sum() - differences.max()) - prior > -np.log(level)


def of_size(items: Iterable[Scored], size: int) -> list[Scored]:
  """Returns the explanations by a number of effects alone."""
  alone = (item for item in items if not (item.neutral or item.beside_force))
  return [item for item in alone if len(item.names) == size]
