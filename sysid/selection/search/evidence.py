"""A scored hypothesis of one joint, and how clear its evidence is of another's."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.stats import chi2, norm, rankdata
from scipy.stats import t as student

from nerf2real.sysid.fit.layout import Fit
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.terms import FREE, Term

Array = np.ndarray

UNREPEATED = ("backlash",)
"""Kinds under which a course does not repeat: which way teeth bounce depends on microradians."""

_RAREST, _SMALL = 1e-300, 1e-8  # probabilities: the least, and from where on tan is 1 / angle
_LEAST_SHARE = 1e-3  # of a sum, that others hold beside one block
NAT = 1.0  # that a further value costs (Akaike 1974): a smaller difference says nothing


@dataclasses.dataclass
class Scored:
  """A fitted hypothesis of one joint, with its evidence."""

  joint: JointLikelihood
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

  def is_strained(self, level: float) -> bool:
    """Tells whether values are further from their priors' centres than by chance at that level:
    what they take they may take from an effect that the hypothesis lacks."""
    likely = 0.5 * float(chi2.ppf(1.0 - level, max(self.fit.layout.count, 1)))
    return self.prior > likely


def kinds_of(terms: Sequence[Term]) -> frozenset[str]:
  """Returns the kinds of effects that are not the machine's anyway."""
  return frozenset(t.name for t in terms if t.name is not None)


def clear(better: Scored, other: Scored) -> float:
  """Returns how clear a difference of evidence is, in standard errors; see `clearness`."""
  apart = better.fit.residuals[0] - other.fit.residuals[0]
  expected = [better.joint.told_apart(apart)]
  return clearness([better.nats - other.nats], better.prior - other.prior, expected)


def clearness(rows: Sequence[Array], prior: float, expected: Sequence[Array]) -> float:
  """Returns how clear a difference of two hypotheses is, in standard errors.

  Three paired tests of blocks together: of their sum about their mean (Vuong 1989), about what each
  is expected to differ by (`by_pattern`), and of the signed ranks of neighbouring pairs (Wilcoxon
  1945), as one without a distribution is wanted where few blocks hold most of a sum (Clarke 2007).
  Ranks know no size: pairs that differ by less than a nat, as an effect that imitates what no
  hypothesis holds makes them, agree with neither hypothesis. Their probabilities, which are of the
  same blocks, are combined as Cauchy's distribution lets them (Liu and Xie 2020): where one alone
  is clear it counts a third, where all agree nothing is lost.

  Args:
    rows: differences of nats of blocks, one array for each joint; joints are independent.
    prior: nats that the priors cost more.
    expected: nats by which the blocks tell the two apart if one of them holds, as `rows`.
  """
  total = float(sum(row.sum() for row in rows)) - prior
  by_sum = total / max(float(np.sqrt(sum(variance(row) for row in rows))), NAT)
  pairs = np.concatenate([np.add.reduceat(row, np.arange(0, len(row), 2)) for row in rows])
  pairs = pairs - prior / len(pairs)
  ranks = rankdata(np.abs(pairs))
  agree = np.sign(pairs) * (np.abs(pairs) >= NAT)
  by_ranks = float(agree @ ranks / np.sqrt(ranks @ ranks))
  return combined([by_sum, by_pattern(rows, prior, expected), by_ranks])


def combined(tests: Sequence[float]) -> float:
  """Returns the standard errors of tests together, whatever they have in common.

  The mean of tan(pi (1/2 - p)) over tests has nearly Cauchy's distribution (Liu and Xie 2020).

  Args:
    tests: their standard errors.
  """
  rare = np.maximum(norm.sf(tests), _RAREST)
  mean = float(np.where(rare < _SMALL, 1.0 / (np.pi * rare), np.tan(np.pi * (0.5 - rare))).mean())
  if mean < 0.0:  # probabilities near 1 are not resolved
    return -combined([-test for test in tests])
  together = 1.0 / (np.pi * mean) if mean > 1.0 / _SMALL else 0.5 - np.arctan(mean) / np.pi
  return float(norm.isf(together))


def by_pattern(rows: Sequence[Array], prior: float, expected: Sequence[Array]) -> float:
  """Returns a sum of blocks' differences over its standard error, the scatter of blocks about what
  they are expected to differ by.

  A motion excites an effect in some blocks far more than in others. About their mean differences
  scatter by that alone; about the line through the origin that the two predictions draw (a ratio
  estimate, Cochran 1977) they scatter by what neither hypothesis holds. A block counts as if the
  line had been drawn without it, and few blocks that tell have few degrees of freedom (Student).

  Args:
    rows: differences of nats [B] a joint.
    prior: nats that the priors cost more.
    expected: what they are expected to be [B] a joint, up to one factor.
  """
  total = float(sum(row.sum() for row in rows)) - prior
  whole = float(sum(g.sum() for g in expected))
  if whole <= 0.0:
    return 0.0
  squares = sum(
    _scatter((row - total / whole * g) / np.maximum(1.0 - g / whole, _LEAST_SHARE))
    for row, g in zip(rows, expected, strict=True)
  )
  telling = whole**2 / float(sum(g @ g for g in expected))  # blocks
  over_error = total / max(float(np.sqrt(squares)), NAT)
  rare = student.sf(abs(over_error), max(telling - 1.0, _LEAST_SHARE))
  return float(np.sign(over_error) * norm.isf(rare))


def standardised(differences: Array, least: float = 1e-300) -> float:
  """Returns a sum of blocks' differences over its standard error, which is at least so large."""
  return float(differences.sum()) / max(np.sqrt(variance(differences)), least)


def variance(differences: Array) -> float:
  """Returns the variance of a sum of blocks' differences, of which neighbours may go together."""
  count = len(differences)
  return _scatter(differences - differences.mean()) * count / max(count - 1, 1)


def _scatter(errors: Array) -> float:
  """Returns the sum of squares of blocks' errors, with what neighbours have in common."""
  own = float(errors @ errors)
  return max(own + 2.0 * float(errors[1:] @ errors[:-1]), own)


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
