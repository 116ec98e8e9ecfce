"""One joint's case: its race, what is concluded of it, and the final fit of what was chosen."""

import dataclasses

from sysid import decision, detection, explanation, race
from sysid.decision import Finding, Thresholds
from sysid.explanation import Effort, Ladder
from sysid.race import CLOCKS, Entry
from sysid.screening import Screened

_RELATIVE = {"friction": 2.5, "gain": 0.3}
"""Spread of a constant over that of the others, as `candidates.calibration` has it."""

_NO_LATENCY = 2e-4
"""s; spread of latencies beside a delay, from which they cannot be told."""


@dataclasses.dataclass
class Found:
  """One raced joint."""

  screened: Screened
  ladder: Ladder
  finding: Finding
  chance: dict[str, float]

  @property
  def joint(self) -> str:
    """Its name."""
    return self.screened.joint


def race_joint(screened: Screened, thresholds: Thresholds, effort: Effort, *, seed: int) -> Found:
  """Races all candidates on a joint and decides; what chance gains raises the threshold."""
  ladder = explanation.climb(
    screened.problem, screened.calibration, screened.declared, screened.null, effort=effort
  )
  chance = detection.chance_gain(screened.problem, ladder.null, ladder.singles[:12], seed=seed)
  own = dataclasses.replace(
    thresholds,
    gain=max(thresholds.gain, 2.0 * chance["q95"]),
    adequate=thresholds.adequate + screened.background,
  )
  return Found(screened, ladder, decision.decide(ladder, own), chance)


def polished(item: Found, spread: float) -> Entry:
  """Fits the chosen hypothesis to the end, constants held as near to declared as their like."""
  entry = item.finding.chosen
  terms = list(entry.fit.terms)
  prior = dict(zip(terms[0].names, terms[0].prior, strict=True))
  if not terms[0].centre:  # neither reference logs nor other joints tell
    prior = {n: p if n in CLOCKS else _RELATIVE.get(n, 1.0) * spread for n, p in prior.items()}
  if {"command_delay", "measurement_delay"} & decision.names(entry):
    # A delay takes in what latency there is beside it.
    prior = {n: min(p, _NO_LATENCY) if n in CLOCKS else p for n, p in prior.items()}
  terms[0] = dataclasses.replace(terms[0], prior=tuple(prior.values()))
  problem = item.screened.problem
  as_declared = entry.fit.x.copy()
  as_declared[: len(terms[0].names)] = terms[0].starts[0]
  fits = [problem.fit(terms, x, evaluations=40) for x in (entry.fit.x, as_declared)]
  return race.entry(problem, min(fits, key=lambda f: f.cost))
