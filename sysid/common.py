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

from sysid import decision, explanation, intervals, race
from sysid.joint import Found
from sysid.race import CLOCKS
from sysid.screening import Screened
from sysid.terms import Term, compose

Array = np.ndarray

WHOLE = ("clock_drift", "supply_sag", "gravity_tilt")
"""Kinds that have no target: they concern all joints or none."""
_LATE = ("command_delay", "measurement_delay")
"""Kinds that can be a joint's or the bus's."""
_FEWEST = 4  # joints from which a spread of constants is told
_NARROWEST = 0.5  # of the prior's own spread; a joint may differ from its like
_TO_SIGMA = 1.4826  # median absolute deviation of a normal distribution, to its standard deviation
_GAIN = 0.05  # nats that the other joints must gain in the mean; ours
_LOSS = 0.15  # nats that a joint may lose; ours
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
  """Centres every joint's constants on what the other joints have, and fits the null anew."""
  if len(screened) < _FEWEST or any(s.calibration.centre for s in screened):
    return
  values = {s.joint: s.null.fit.values("calibration") for s in screened}
  for s in screened:
    centre, prior = [], []
    for name, spread in zip(s.calibration.names, s.calibration.prior, strict=True):
      others = [v[name] for joint, v in values.items() if joint != s.joint and name in v]
      if name in CLOCKS or len(others) < _FEWEST - 1:
        centre.append(0.0)
        prior.append(spread)
        continue
      middle = float(np.median(others))
      width = 1.5 * _TO_SIGMA * float(np.median(np.abs(np.array(others) - middle)))
      centre.append(middle)
      prior.append(float(np.clip(width, _NARROWEST * spread, spread)))
    s.calibration = dataclasses.replace(
      s.calibration, centre=tuple(centre), prior=tuple(prior),
      starts=(tuple(centre), *s.calibration.starts),
    )  # fmt: skip
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
      gains = [_gain(s, term, x) for s in screened if s.joint != item.joint]
      if not gains or np.mean(gains) < _GAIN or np.quantile(gains, 0.1) < -_LOSS:
        continue
      if kind in _LATE and np.mean(np.array(gains) > _GAIN) < _SHARE:
        continue
      if best is None or np.mean(gains) > best.gain:
        best = Shared(
          dataclasses.replace(term, target=None), x.copy(), float(np.mean(gains)),
          intervals.intervals(item.screened.problem, chosen.fit, kind),
          decision.evidence(chosen, item.ladder),
        )  # fmt: skip
  return best


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
    _, _, s.null = explanation.bare(s.problem, s.calibration)
