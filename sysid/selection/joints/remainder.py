"""What remains of a joint's residual under its best hypothesis, against what it leaves anyway."""

import numpy as np
from scipy.stats import chi2, norm

from nerf2real.sysid.fit.expectation import NEIGHBOURS
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.model.measured import quantum
from nerf2real.sysid.selection.search.evidence import Scored
from nerf2real.sysid.settings import Settings

Array = np.ndarray


def structured(
  joint: JointLikelihood,
  item: Scored,
  settings: Settings,
  allowed: Array | float = 0.0,
  scattered: Array | float = 0.0,
) -> bool:
  """Tells whether neighbouring readings' residuals go together in more than one block, which may
  hold a knock, by more than rounding makes them where a joint is slow. A log's first block is not
  judged: its course begins at one reading, which is rounded.

  Args:
    joint: the logs.
    item: the hypothesis.
    settings: limits.
    allowed: mean squares [B] of what may go together besides, on average: as much larger as it is
      by chance, too.
    scattered: the same of what differs from block to block, so that half of a log's blocks are not
      larger.
  """
  certain, size = _together(joint, item.fit.residuals[0][0])
  later = np.append(False, np.diff(joint.log_of) == 0)
  # Two of B blocks exceed z by chance with a probability of (B p)^2 / 2 at most.
  chance = np.sqrt(2.0 * settings.level) / max(int(later.sum()), 1)
  rare = float(norm.isf(chance))
  step = min(quantum(log.position) for log in joint.plant.logs)
  recordings = 1 if joint.expectation is None else 2
  least = (settings.structured * joint.position_noise) ** 2 + recordings * step**2 / 12.0
  by_chance = float(chi2.isf(chance, 1))

  def more(than: Array | float) -> Array:
    return later & (certain > rare) & (size > least + than)

  if int(more(by_chance * (allowed + scattered)).sum()) >= 2:
    return True
  of_log, judged = joint.log_of[more(by_chance * allowed + scattered)], joint.log_of[later]
  count = int(joint.log_of[-1]) + 1
  return bool(
    np.any(2 * np.bincount(of_log, minlength=count) > np.bincount(judged, minlength=count))
  )


def repeats(joint: JointLikelihood, item: Scored, sigma: Array) -> Array:
  """Returns the mean squares of blocks [B] by which a hypothesis' values, as far as they differ
  between two recordings of one machine, move its course.

  Args:
    joint: the logs.
    item: the hypothesis.
    sigma: standard deviations of its values [n]; those that are infinite do not count.
  """
  known = np.isfinite(sigma)
  moved = item.fit.jacobian[0][known] * sigma[known, None, None]
  squares: Array = np.sum([joint.squares(row)[0] for row in moved], axis=0)
  return squares


def mean_left(joint: JointLikelihood, squares: Array) -> float:
  """Returns the mean square of blocks [B] but for the largest of every log, which may hold a knock:
  a misfit may be in few blocks, as where a detent is passed."""
  kept = np.ones(len(squares), bool)
  for log in np.unique(joint.log_of):
    of_log = np.flatnonzero(joint.log_of == log)
    if len(of_log) > 1:
      kept[of_log[np.argmax(squares[of_log])]] = False
  return float(squares[kept].mean())


def scatter(joint: JointLikelihood, item: Scored) -> Array:
  """Returns the mean squares of blocks [B] that a hypothesis leaves in readings made by itself:
  where a course does not repeat, a simulation that follows them strays all the same."""
  random = np.random.default_rng(0)
  c = compose(joint.plant, item.terms, item.fit.x)
  residual = []
  for index, log in enumerate(joint.plant.logs):
    made = joint.plant.run(c.p, c.loads, index, table=c.table).position
    read = made + random.normal(0.0, joint.position_noise, len(made))
    read = np.where(log.valid, read, np.nan)
    near = joint.plant.run(c.p, c.loads, index, table=c.table, follow=True, readings=read)
    residual.append(np.nan_to_num(read - near.position))
  rows = np.zeros((len(joint.channels), joint.size))
  rows[0] = np.concatenate(residual)
  return joint.squares(rows * joint.gain)[0]


def grown(best: Scored, usual: Scored, beyond: float, settings: Settings) -> bool:
  """Tells whether blocks leave more than a reference's do, on a logarithmic scale.

  Args:
    best: hypothesis of the logs.
    usual: that of the reference.
    beyond: standard errors that count as clear.
    settings: limits.
  """
  mine, usually = (0.5 * np.log(s.fit.held[0][0] + 1e-30) for s in (best, usual))
  error = np.sqrt(np.var(mine) / len(mine) + np.var(usually) / len(usually))
  ratio = float(mine.mean() - usually.mean())
  return ratio > beyond * error or ratio > float(np.log(settings.more))


def _together(joint: JointLikelihood, residual: Array) -> tuple[Array, Array]:
  """Returns how surely neighbouring readings' residuals go together in a block, and how much [B].

  Sum of products over its standard error under independence, and the mean product: beyond what the
  noise of a reference makes of what is expected of neighbours.
  """
  products = np.append(residual[1:] * residual[:-1], 0.0)
  if joint.expectation is not None:
    read = joint.mask * np.append(joint.mask[1:], 0.0)
    products -= NEIGHBOURS * joint.position_noise**2 * read
  total = np.add.reduceat(products, joint.starts)
  error = np.sqrt(np.add.reduceat(products**2, joint.starts))
  return total / np.maximum(error, 1e-300), total / joint.counts[0]
