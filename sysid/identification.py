"""From a declared model and logs to a verdict: `sysid.identify`.

audit -> screening of joints -> race on the suspects -> decision -> intervals -> learned force where
nothing fits -> error of the declared and the extended model by MuJoCo -> files.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from suite.effects import Effect
from sysid import (
  decision,
  detection,
  elaboration,
  explanation,
  intervals,
  learned,
  race,
  screening,
)
from sysid.audit import audit
from sysid.chain import ancestors, share
from sysid.decision import Finding, Thresholds
from sysid.evaluation import Clocks
from sysid.explanation import Effort, Ladder
from sysid.logs import Log, check_against_model, read_log
from sysid.race import Entry
from sysid.screening import Screened
from sysid.terms import Term

Array = np.ndarray

_RELATIVE = {"friction": 2.5, "gain": 0.3}
"""Spread of a constant over that of the others, as `candidates.calibration` has it."""

_NO_LATENCY = 2e-4
"""s; spread of latencies beside a delay, from which they cannot be told."""

COMMON = ("clock_drift", "supply_sag", "gravity_tilt")
"""Kinds that have no target: they concern all joints or none."""


@dataclasses.dataclass(frozen=True)
class Settings:
  """How an identification is done."""

  thresholds: Thresholds = Thresholds()
  """When a hypothesis is believed."""
  effort: Effort = Effort()
  """How much is computed."""
  suspects: int = 3
  """Joints of several that are raced, those that the null model explains least."""
  suspicious: float = 0.12
  """nats above the median joint at which a joint is raced."""
  window_s: float = 0.5
  """Length of the windows where an actuator does not hold position."""
  seed: int = 0
  """Of resampling."""


@dataclasses.dataclass
class Found:
  """One raced joint."""

  screened: Screened
  ladder: Ladder
  finding: Finding
  chance: dict[str, float]


@dataclasses.dataclass
class Identified:
  """What an identification found, before it is written down."""

  model: mujoco.MjModel
  logs: list[Log]
  screened: list[Screened]
  found: list[Found]
  verdict: str
  effects: list[dict[str, Any]]
  """Entries of the report."""
  objects: list[Effect]
  """The same as effects that can be simulated."""
  calibration: list[Effect]
  """Declared constants corrected, one effect a joint."""
  clocks: dict[str, Clocks]
  learned: list[Effect]
  audits: list[dict[str, Any]]


def load_model(path: Path) -> mujoco.MjModel:
  """Reads a MuJoCo model; a file that is missing or wrong is one clear error."""
  if not Path(path).is_file():
    raise FileNotFoundError(f"Found no file {path}, expected a MuJoCo model (.xml).")
  try:
    return mujoco.MjModel.from_xml_path(str(path))
  except ValueError as error:
    first = str(error).strip().splitlines()[0]
    raise ValueError(f"{path} is not a MuJoCo model: {first}") from error


def read_logs(paths: Sequence[Path], model: mujoco.MjModel) -> list[Log]:
  """Reads logs and checks them against the model."""
  logs = []
  for path in paths:
    log = read_log(path)
    check_against_model(log, model)
    logs.append(log)
  return logs


def analyse(
  model: mujoco.MjModel,
  logs: list[Log],
  *,
  reference: Sequence[Log] = (),
  settings: Settings | None = None,
) -> Identified:
  """Finds what a model lacks."""
  settings = settings or Settings()
  screened = screening.screen(model, logs, reference=reference, window_s=settings.window_s)
  if not screened:
    raise ValueError(
      "Found no joint with an actuator that all logs command, expected at least one."
    )
  chosen = _suspects(screened, settings)
  found = [_race(s, settings) for s in chosen]
  found = _without_contradictions(found, settings)
  found += _others(found, screened, settings)
  result = Identified(
    model, logs, screened, found, "none", [], [], [], {}, [], [audit(log) for log in logs]
  )
  _conclude(result, settings)
  return result


def _suspects(screened: list[Screened], settings: Settings) -> list[Screened]:
  """Returns the joints to race: those above the others, at least the first."""
  if len(screened) <= 2:
    return screened[: settings.suspects]
  usual = float(np.median([s.excess for s in screened]))
  high = [s for s in screened if s.excess > usual + settings.suspicious]
  return (high or screened[:1])[: settings.suspects]


def _race(screened: Screened, settings: Settings) -> Found:
  ladder = explanation.climb(
    screened.problem, screened.calibration, screened.declared, screened.null,
    effort=settings.effort,
  )  # fmt: skip
  chance = detection.chance_gain(
    screened.problem, ladder.null, ladder.singles[:12], seed=settings.seed
  )
  thresholds = dataclasses.replace(
    settings.thresholds,
    gain=max(settings.thresholds.gain, 2.0 * chance["q95"]),
    adequate=settings.thresholds.adequate + screened.background,
  )
  return Found(screened, ladder, decision.decide(ladder, thresholds), chance)


def _without_contradictions(found: list[Found], settings: Settings) -> list[Found]:
  """Demotes kinds that concern all joints where another joint does not show them."""
  if len(found) < 2:
    return found
  for item in found:
    for kind in COMMON:
      holders = [f for f in found if kind in decision.names(f.finding.chosen)]
      if item in holders and len(holders) < len(found):
        ladder = item.ladder
        ladder.singles = [e for e in ladder.singles if kind not in decision.names(e)]
        ladder.pairs = [e for e in ladder.pairs if kind not in decision.names(e)]
        item.finding = decision.decide(ladder, settings.thresholds)
  return found


def _others(found: list[Found], screened: list[Screened], settings: Settings) -> list[Found]:
  """Looks for what several raced joints have in the joints that were not raced.

  A machine's servos are of one kind: what two of them have, the others are asked for too.
  """
  shared: dict[str, Entry] = {}
  for item in found:
    for kind in decision.names(item.finding.chosen) if item.finding.named else ():
      same = [f for f in found if f.finding.named and kind in decision.names(f.finding.chosen)]
      single = [e for e in item.ladder.singles if decision.names(e) == {kind}]
      if len(same) > 1 and kind not in (*COMMON, "payload") and single:
        shared.setdefault(kind, single[0])
  raced = {f.screened.joint for f in found}
  result = []
  for s in screened:
    if s.joint in raced or not shared:
      continue
    entries = []
    for entry in shared.values():
      term = dataclasses.replace(entry.fit.terms[-1], target=s.joint)
      start = np.concatenate([s.null.fit.x, entry.fit.part(len(entry.fit.terms) - 1)])
      entries.append(race.entry(s.problem, s.problem.fit([s.calibration, term], start)))
    entries.sort(key=lambda e: e.score)
    ladder = Ladder(s.problem, s.calibration, s.declared, s.null, entries, [])
    finding = decision.decide(ladder, settings.thresholds)
    if finding.named:
      chance = detection.chance_gain(s.problem, s.null, entries, seed=settings.seed)
      result.append(Found(s, ladder, finding, chance))
  return result


def _conclude(result: Identified, settings: Settings) -> None:
  """Fills in verdict, effects, calibration and clocks."""
  _merge_payloads(result, settings)
  named = [f for f in result.found if f.finding.named]
  spread = screening.shared_spread(
    result.screened, named[0].finding.chosen if len(result.screened) == 1 and named else None
  )
  entries: list[tuple[Found, Entry]] = []
  for item in result.found:
    entry = item.finding.chosen
    if item.finding.verdict == "unexplained":
      entry = elaboration.elaborate(item.ladder, entry)
    if entry is not item.finding.chosen:
      item.finding = dataclasses.replace(item.finding, chosen=entry, named=True)
    elif item.finding.named:
      entry = _polished(item, spread)
    entries.append((item, entry))
  by_joint = {item.screened.joint: entry for item, entry in entries}
  for item, entry in entries:
    for term in entry.fit.terms:
      if term.kind == "calibration" or not item.finding.named:
        continue
      _add_effect(result, item, entry, term)
  for s in result.screened:
    entry = by_joint.get(s.joint, s.null)
    values = entry.fit.values("calibration")
    result.clocks[s.joint] = Clocks(values.get("skew", 0.0), values.get("latency", 0.0))
    term = entry.fit.terms[0]
    effect = term.effect(entry.fit.part(0))
    result.calibration.append(dataclasses.replace(effect, target=s.joint))
  constants = [s for s in result.screened if _constants(s, by_joint, settings)]
  for s in constants:
    _add_constants(result, s, by_joint.get(s.joint, s.null))
  unexplained = [f for f in result.found if f.finding.verdict == "unexplained"]
  if unexplained:
    result.verdict = "unexplained"
    for item in unexplained:
      force, _, _ = learned.learn(item.screened.problem, by_joint[item.screened.joint].fit)
      if force is not None:
        result.learned.append(force)
  elif result.effects:
    result.verdict = "effects"


def _constants(s: Screened, by_joint: dict[str, Entry], settings: Settings) -> bool:
  entry = by_joint.get(s.joint, s.null)
  return decision.constants_off(entry, s.declared, s.null, settings.thresholds)


def _polished(item: Found, spread: float) -> Entry:
  """Fits the chosen hypothesis to the end, constants held as near to declared as their like."""
  entry = item.finding.chosen
  terms = list(entry.fit.terms)
  if not terms[0].centre:  # not fixed by reference logs
    prior = tuple(
      p if n in ("skew", "latency") else _RELATIVE.get(n, 1.0) * spread
      for n, p in zip(terms[0].names, terms[0].prior, strict=True)
    )
    late = {"command_delay", "measurement_delay"} & decision.names(entry)
    if late:  # a delay takes in what latency there is beside it
      prior = tuple(
        _NO_LATENCY if n in ("skew", "latency") else p
        for n, p in zip(terms[0].names, prior, strict=True)
      )
    terms[0] = dataclasses.replace(terms[0], prior=prior)
  problem = item.screened.problem
  as_declared = entry.fit.x.copy()
  as_declared[: len(terms[0].names)] = terms[0].starts[0]
  fits = [problem.fit(terms, x, evaluations=40) for x in (entry.fit.x, as_declared)]
  return race.entry(problem, min(fits, key=lambda f: f.cost))


def _add_effect(result: Identified, item: Found, entry: Entry, term: Term) -> None:
  problem = item.screened.problem
  index = entry.fit.terms.index(term)
  bounds = intervals.intervals(problem, entry.fit, term.kind)
  effect = term.effect(entry.fit.part(index), bounds)
  if any(e.kind == effect.kind and e.target == effect.target for e in result.objects):
    return
  slide = not problem.plant.hinge
  result.objects.append(effect)
  result.effects.append(
    {
      "kind": term.kind,
      "joint": None if term.kind in COMMON else item.screened.joint,
      **({"body": term.target} if term.kind == "payload" else {}),
      "parameters": {
        name: {
          "value": _plain(effect.parameters[name]),
          "low": _plain(bounds.get(name, (np.nan, np.nan))[0]),
          "high": _plain(bounds.get(name, (np.nan, np.nan))[1]),
          "unit": term.unit(name, slide=slide),
        }
        for name in effect.parameters
      },
      "evidence": {
        **decision.evidence(entry, item.ladder),
        "runner_up_behind_nats": _runner_up(item),
        "chance_gain_q95_nats": round(item.chance["q95"], 4),
      },
    }
  )


def _runner_up(item: Found) -> float | None:
  size = len(decision.names(item.finding.chosen))
  behind = [
    e.score - item.finding.chosen.score
    for e in item.finding.alternatives
    if len(decision.names(e)) <= size
  ]
  return round(float(min(behind)), 4) if behind else None


def _add_constants(result: Identified, s: Screened, entry: Entry) -> None:
  term = entry.fit.terms[0]
  raw = intervals.intervals(s.problem, entry.fit, "calibration")
  effect = term.effect(entry.fit.part(0), raw)
  result.effects.append(
    {
      "kind": "parameter_error",
      "joint": s.joint,
      "parameters": {
        name: {
          "value": _plain(value),
          "low": _plain(effect.intervals[name][0]),
          "high": _plain(effect.intervals[name][1]),
          "unit": "1",
        }
        for name, value in effect.parameters.items()
      },
      "evidence": {"gain_over_declared_nats": round(float(s.declared.score - s.null.score), 4)},
    }
  )


def _plain(value: Any) -> Any:
  if isinstance(value, (list, tuple)):
    return list(value)
  return float(value) if np.isfinite(value) else None


def _merge_payloads(result: Identified, settings: Settings) -> None:
  """Replaces payloads on several joints of one chain by one payload that all of them feel.

  A payload shows in every joint between it and the base. Each carrying body is tried with all
  raced joints that carry it; the one that explains most over all of them is kept.
  """
  carriers = [f for f in result.found if f.finding.named and _payload_entry(f) is not None]
  if not carriers or len(result.screened) < 2:
    return
  model = result.model
  by_joint = {f.screened.joint: f for f in result.found}
  best: tuple[float, list[tuple[Found, Entry]]] | None = None
  for carrier in carriers:
    entry = _payload_entry(carrier)
    assert entry is not None
    term = next(t for t in entry.fit.terms if t.kind == "payload")
    joint = model.joint(carrier.screened.joint).id
    chain = ancestors(model, int(model.jnt_bodyid[joint]))
    items = [by_joint[j] for j in chain if j in by_joint]
    values = entry.fit.values("payload")
    start = np.array([values[n] for n in term.names])
    parts = [(f.screened.problem, f.screened.calibration) for f in items]
    entries = share(parts, term, start)
    gain = sum(f.ladder.null.score - e.score for f, e in zip(items, entries, strict=True))
    if best is None or gain > best[0]:
      best = gain, list(zip(items, entries, strict=True))
  assert best is not None
  for rank, (item, entry) in enumerate(best[1]):
    own = item.finding.chosen
    if rank == 0 or entry.score - own.score < settings.thresholds.second:
      left = race.above_floor(entry) > settings.thresholds.adequate
      item.finding = dataclasses.replace(
        item.finding,
        chosen=entry,
        named=rank == 0,
        verdict="unexplained" if left else ("effects" if rank == 0 else "none"),
      )


def _payload_entry(item: Found) -> Entry | None:
  """Returns a joint's best hypothesis of a payload alone if it is nearly as good as the chosen."""
  entries = [e for e in item.ladder.singles if decision.names(e) == {"payload"}]
  if not entries or entries[0].score - item.finding.chosen.score > 0.5:
    return None
  return entries[0]
