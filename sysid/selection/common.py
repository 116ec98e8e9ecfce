"""What all joints of a machine share: how far declared constants are off, and effects of the whole.

Servos of a machine are of one batch and hang on one bus. What one joint alone leaves open (is it
weaker, or are all its constants larger?) the others decide. An effect that concerns all joints is
found on the joint that shows it most, tried on all, and then declared, so that what else a joint
has can be seen.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.sysid.fit import intervals
from nerf2real.sysid.hypotheses.terms import Term, compose
from nerf2real.sysid.selection import decision, race
from nerf2real.sysid.selection.joint import Found
from nerf2real.sysid.selection.race import CLOCKS
from nerf2real.sysid.selection.screening import Screened

Array = np.ndarray

WHOLE = ("clock_drift", "supply_sag", "gravity_tilt")
"""Kinds that have no target: they concern all joints or none."""
_LATE = ("command_delay", "measurement_delay")
"""Kinds that can be a joint's or the bus's."""
_FEWEST = 2  # joints of which one tells the latencies of the other; constants take three
_NARROWEST = 0.5  # of the prior's own spread; a joint may differ from its like
_TO_SIGMA = 1.4826  # median absolute deviation of a normal distribution, to its standard deviation
_GAIN = 0.05  # nats that the other joints must gain in the mean; ours
_LOSS = 0.15  # nats that a joint may lose; ours
_ASKED = 5  # joints that an effect's values are asked of, those that show it most
_SUREST = 0.003  # of a value's typical size, that a joint's fit can be sure of at most; ours
_SHARE = 0.8  # of joints that a late bus must show in; ours


@dataclasses.dataclass(frozen=True)
class Shared:
  """An effect of the whole machine."""

  term: Term
  x: Array
  """Values [n]."""
  gain: float
  """nats that the other joints gain in the mean."""
  bounds: dict[str, tuple[float, float]]
  """95 % intervals, from the joint that it was found on."""
  evidence: dict[str, Any]
  """Of that joint."""


def expect_like_the_others(screened: Sequence[Screened]) -> None:
  """Centres every joint's constants and latencies on what the others have; fits the nulls anew."""
  if len(screened) < _FEWEST or any(s.calibration.centre and s.alone is None for s in screened):
    return  # too few, or reference logs have told already
  values = {s.joint: s.null.fit.values("calibration") for s in screened}
  for s in screened:
    s.alone = s.alone or s.calibration
    centre, prior = [], []
    for name, spread in zip(s.alone.names, s.alone.prior, strict=True):
      others = [v[name] for joint, v in values.items() if joint != s.joint and name in v]
      middle = float(np.median(others)) if others else 0.0
      width = 1.5 * _TO_SIGMA * float(np.median(np.abs(np.array(others) - middle)))
      narrow = name not in CLOCKS and len(others) > 1
      centre.append(middle if narrow or name in CLOCKS else 0.0)
      prior.append(float(np.clip(width, _NARROWEST * spread, spread)) if narrow else spread)
    s.calibration = dataclasses.replace(
      s.alone, centre=tuple(centre), prior=tuple(prior), starts=(tuple(centre), *s.alone.starts)
    )
    s.null = race.entry(s.problem, s.problem.fit([s.calibration]))


def shared_effect(found: Sequence[Found], screened: Sequence[Screened]) -> Shared | None:
  """Returns the effect of the whole machine that explains most, None if there is none.

  Args:
    found: the raced joints with what was concluded of each alone.
    screened: all joints.
  """
  best: Shared | None = None
  for item in found:
    chosen = item.finding.chosen
    if not item.finding.named:
      continue
    for kind in decision.names(chosen) & {*WHOLE, *_LATE}:
      index = [t.kind for t in chosen.fit.terms].index(kind)
      term, x = chosen.fit.terms[index], chosen.fit.part(index)
      gains = {s.joint: _gain(s, term, x) for s in screened if s.joint != item.joint}
      values = np.array(list(gains.values()))
      if not gains or values.mean() < _GAIN or np.quantile(values, 0.1) < -_LOSS:
        continue
      if kind in _LATE and np.mean(values > _GAIN) < _SHARE:
        continue
      if best is None or values.mean() > best.gain:
        most = sorted(gains, key=lambda joint: -gains[joint])[: _ASKED - 1]
        asked = [s for s in screened if s.joint in (item.joint, *most)]
        whole = dataclasses.replace(term, target=None)
        x, spread = _agreed(asked, whole, x)
        best = Shared(
          whole,
          x,
          float(values.mean()),
          intervals.around(whole, x, spread),
          decision.evidence(chosen, item.ladder),
        )
  return best


def _agreed(asked: Sequence[Screened], term: Term, start: Array) -> tuple[Array, Array]:
  """Returns the values [n] that joints agree on and their standard deviations [n].

  The joints' own fits are weighted by their information; where they differ by more than their
  covariances say (Birge's ratio), the deviations grow.
  """
  fits = []
  for s in asked:
    x = np.concatenate([s.null.fit.x, start])
    fit = s.problem.fit([s.calibration, term], x, evaluations=20)
    own = slice(len(s.null.fit.x), None)
    fits.append((fit.part(1), intervals.covariance(s.problem, fit)[own, own]))
  least = np.diag(np.square(_SUREST * np.array(term.scale)))  # a value on its bound varies by 0
  informations = [np.linalg.inv(c + least) for _, c in fits]
  together = np.linalg.pinv(sum(informations, np.zeros_like(informations[0])))
  x = together @ sum((i @ v for i, (v, _) in zip(informations, fits, strict=True)), 0 * start)
  off = [(v - x) @ i @ (v - x) for i, (v, _) in zip(informations, fits, strict=True)]
  birge = max(1.0, float(np.sum(off)) / max(len(start) * (len(fits) - 1), 1))
  x = np.clip(x, term.low, term.high)
  return x, np.sqrt(np.maximum(np.diag(together), 0.0) * birge)


def _gain(s: Screened, term: Term, x: Array) -> float:
  """Returns what a joint gains if it has an effect with these very values, nats."""
  held = term.held_at(x)
  entry = race.entry(s.problem, s.problem.fit([s.calibration, held], evaluations=12))
  return s.null.score - entry.score


def declare(shared: Shared, screened: Sequence[Screened]) -> None:
  """Puts an effect of the whole machine into every joint's declared model; fits the nulls anew."""
  for s in screened:
    plant = s.problem.plant
    parameters, surroundings = compose(plant, [shared.term], shared.x)
    plant.absorb(shared.term.kind, parameters, surroundings)
    s.calibration = s.alone or s.calibration
    s.null = race.entry(s.problem, s.problem.fit([s.calibration]))
  expect_like_the_others(screened)
