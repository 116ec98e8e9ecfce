"""Compares what an analyser reports with what is in a blind set; pure functions.

A report is that of `launch/identify.py`; a truth is an entry of answers.json. Every machine has its
own constants, so `parameter_error` beside an effect is never counted as a wrong name; effects that
cannot be seen (`below_floor`) are kept apart from all rates.
"""

import dataclasses
from typing import Any

import numpy as np

Entry = dict[str, Any]

CONSTANTS = "parameter_error"
NOT_NAMES = (CONSTANTS, "residual_force")

# Parameters that make an effect's size; the others (places, phases, time constants) are its shape.
SIZES: dict[str, tuple[str, ...]] = {
  "command_delay": ("delay",),
  "measurement_delay": ("delay",),
  "clock_drift": ("rate",),
  "coulomb_friction": ("torque",),
  "viscous_friction": ("coefficient",),
  "stribeck_friction": ("breakaway",),
  "load_friction": ("coefficient",),
  "asymmetric_friction": ("positive", "negative"),
  "quadratic_drag": ("coefficient",),
  "backlash": ("gap",),
  "encoder_offset": ("offset",),
  "motor_gain": ("gain",),
  "supply_sag": ("droop", "fade"),
  "torque_limit": ("limit",),
  "thermal_derating": ("heating",),
  "payload": ("mass",),
  "spring": ("stiffness",),
  "cogging": ("amplitude", "periods"),
  "gravity_tilt": ("x", "y"),
  CONSTANTS: ("damping", "armature"),
}


@dataclasses.dataclass(frozen=True)
class Score:
  """One set's score; None where the question does not arise."""

  mix: str
  truth: str
  """Kinds and joints that are there."""
  said: str
  """Kinds and joints that were named, or the verdict."""
  below_floor: bool
  right_first: bool | None
  """Singles: the first name is the right one."""
  right_joint: bool | None
  """Effects of one joint: the first finding is at that joint."""
  all_right: bool | None
  """Pairs: both kinds were named."""
  none_wrong: bool
  """No kind was named that is not there, at another joint not even one that is."""
  unexplained: bool | None
  """Outside the library: the verdict is unexplained."""
  accused: bool | None
  """Healthy: an effect was named, or the verdict is unexplained."""
  size_errors: list[float]
  """Relative errors of the sizes of effects that were named rightly."""
  covered: list[bool]
  """Whether the intervals of those sizes hold the truth."""
  gain: float | None
  """Held-out error before over after."""
  over_floor: float | None
  """Held-out error after over the floor that the report states."""
  over_healthy: float | None
  """Held-out error after over the declared model's on the same machine without the effect."""
  right_or_alike: bool | None = None
  """Singles: the right name is the first, or listed as predicting the same as that; None of scores
  that were kept before this was asked."""


def score(truth: Entry, report: Entry) -> Score:
  """Returns the score of a report, `{"failed": message}` where the analyser gave none."""
  mix, effects = truth["mix"], truth["effects"]
  named = _named(report)
  kinds = {effect["kind"] for effect in effects}
  sought = [e for e in named if e["kind"] not in NOT_NAMES or e["kind"] in kinds]
  accusations = [e for e in named if e["kind"] not in NOT_NAMES]
  verdict = report.get("verdict", "failed")
  below = bool(truth.get("below_floor"))
  first = sought[0] if sought else None
  right_first = right_joint = all_right = unexplained = accused = alike = None
  none_wrong = all(any(_is(e, effect) for effect in effects) for e in accusations)
  if mix == "single":
    right_first = first is not None and first["kind"] == effects[0]["kind"]
    alike = right_first or (first is not None and _alike(effects[0], first, report))
  if mix == "pair":
    all_right = kinds <= {e["kind"] for e in named}
  if mix in ("single", "pair", "outside"):
    right_joint = _right_joint(effects, first, report)
  if mix == "outside":
    unexplained = verdict == "unexplained"
  if mix == "healthy":
    accused = bool(accusations) or verdict in ("unexplained", "failed")
  errors, covered = _sizes(effects, named)
  gain, over_floor, over_healthy = _held(truth, report)
  return Score(
    mix=mix,
    truth=_words(effects) or "nothing",
    said=_words(accusations or sought) if accusations or sought else verdict,
    below_floor=below,
    right_first=right_first,
    right_joint=right_joint,
    all_right=all_right,
    none_wrong=none_wrong,
    unexplained=unexplained,
    accused=accused,
    size_errors=errors,
    covered=covered,
    gain=gain,
    over_floor=over_floor,
    over_healthy=over_healthy,
    right_or_alike=alike,
  )


def _named(report: Entry) -> list[Entry]:
  """Returns the effects that a report stands for."""
  stands = report.get("verdict") in ("effects", "partly")
  return list(report.get("effects", [])) if stands else []


def _words(effects: list[Entry]) -> str:
  return " + ".join(f"{e['kind']}@{e.get('joint') or e.get('body') or 'all'}" for e in effects)


def _places(effect: Entry) -> set[str]:
  """Returns the names of joint and body of an effect's target."""
  return {str(effect[key]) for key in ("joint", "body", "target") if effect.get(key)}


def _is(said: Entry, effect: Entry) -> bool:
  """Returns whether an entry of a report is of an effect's kind, and not at another place."""
  places, found = _places(effect), _places(said)
  return said["kind"] == effect["kind"] and not (places and found and not places & found)


def _alike(effect: Entry, first: Entry, report: Entry) -> bool:
  """Returns whether an effect alone is listed as predicting the same as the first name."""
  return any(
    other.get("confounded") and other["kinds"] == [effect["kind"]]
    for other in report.get("alternatives", ())
    if other.get("joint") == first.get("joint")
  )


def _right_joint(truth: list[Entry], first: Entry | None, report: Entry) -> bool | None:
  """Returns whether the first finding is at a joint with an effect; None if none has a joint."""
  places: set[str] = set().union(*(_places(effect) for effect in truth))
  if not places or any(not _places(effect) for effect in truth):
    return None
  found = _places(first) if first is not None else set()
  if not found and isinstance(report.get("residual_at"), dict):
    found = _places(report["residual_at"])
  # One joint alone needs no name.
  alone = len(report.get("joints", ())) == 1 or places == {"joint"}
  return bool(found & places) or (alone and first is not None and not found)


def _value(parameters: Entry, name: str) -> Entry | None:
  value = parameters.get(name)
  if isinstance(value, dict) and value.get("value") is not None:
    return value
  return {"value": value} if isinstance(value, (int, float)) else None


def _sizes(truth: list[Entry], named: list[Entry]) -> tuple[list[float], list[bool]]:
  """Returns relative errors of sizes and whether intervals cover, of rightly named effects."""
  errors, covered = [], []
  for effect in truth:
    match = next((e for e in named if e["kind"] == effect["kind"]), None)
    places = _places(effect)
    if match is None or (places and _places(match) and not places & _places(match)):
      continue
    for name in SIZES.get(effect["kind"], ()):
      actual, reported = effect.get(name), _value(match.get("parameters", {}), name)
      if not actual or reported is None:  # a cause that was not drawn has size 0
        continue
      if effect["kind"] == "thermal_derating":
        # Torque lost per heat: only the product with `derating` shows where no winding is measured.
        other = _value(match["parameters"], "derating")
        scale = 1.0 if other is None else other["value"] / effect["derating"]
        reported = {k: v * scale for k, v in reported.items() if isinstance(v, (int, float))}
      errors.append(abs(reported["value"] - actual) / abs(actual))
      if reported.get("low") is not None and reported.get("high") is not None:
        covered.append(bool(reported["low"] <= actual <= reported["high"]))
  return errors, covered


def _held(truth: Entry, report: Entry) -> tuple[float | None, float | None, float | None]:
  error = report.get("error") or {}
  held, floor = error.get("held") or {}, error.get("floor")
  before, after = held.get("before"), held.get("after")
  if isinstance(floor, dict):
    floor = floor.get("held")
  gain = before / after if before and after else None
  over_floor = after / floor if after and floor else None
  healthy = truth.get("healthy_held_error")
  return gain, over_floor, after / healthy if after and healthy else None


@dataclasses.dataclass(frozen=True)
class Row:
  """One line of the table."""

  question: str
  value: float | None
  """Share or figure; None without a question."""
  of: int
  """How many sets or parameters it is of."""
  target: str
  met: bool | None


def table(scores: list[Score]) -> list[Row]:
  """Returns the figures that the benchmark is judged by, with the targets of the generators' pages
  (`independent_sets/README.md`)."""
  seen = [s for s in scores if not s.below_floor]
  rows = [
    _share("single: right name first", [s.right_first for s in seen], 0.95),
    _share("single: right, or predicts the same", [s.right_or_alike for s in seen], 0.95),
    _share("single: none wrong", [s.none_wrong for s in seen if s.mix == "single"], 0.95),
    _share("right joint", [s.right_joint for s in seen], 0.98),
    _share("healthy: accused", [s.accused for s in seen], 1 / 60, most=True),
    _share("pair: both right", [s.all_right for s in seen], 0.8),
    _share("pair: none wrong", [s.none_wrong for s in seen if s.mix == "pair"], 0.95),
    _share("outside: unexplained", [s.unexplained for s in seen], 0.9),
    _share(
      "outside: wrong confident name",
      [not s.none_wrong if s.mix == "outside" else None for s in seen],
      0.05,
      most=True,
    ),
    _share(
      "all sets: a name that is not there", [not s.none_wrong for s in scores], 0.05, most=True
    ),
  ]
  errors = [e for s in seen for e in s.size_errors]
  covered = [c for s in seen for c in s.covered]
  rows.append(_median("sizes: relative error, median", errors, 0.05))
  cover = _share("sizes: intervals that cover", covered, 0.9)
  if cover.value is not None:
    cover = dataclasses.replace(cover, target="90-98 %", met=0.9 <= cover.value <= 0.98)
  rows.append(cover)
  effects = [s for s in seen if s.mix in ("single", "pair")]
  gains = [s.gain for s in effects if s.gain is not None]
  gain = _median("held-out error, before over after, median", gains, 4.0)
  enough = None if gain.value is None else gain.value >= 4
  rows.append(dataclasses.replace(gain, target=">= 4", met=enough))
  rows.append(
    _median(
      "held-out error, after over the stated floor, median",
      [s.over_floor for s in effects if s.over_floor is not None],
      1.15,
    )
  )
  healthy = [s.over_healthy for s in effects if s.over_healthy is not None]
  over = _median("held-out error, after over the healthy machine's, median", healthy, 1.0)
  rows.append(dataclasses.replace(over, target="-", met=None))
  return rows


def _share(
  question: str, answers: list[bool | None] | list[bool], target: float, *, most: bool = False
) -> Row:
  given = [bool(a) for a in answers if a is not None]
  value = float(np.mean(given)) if given else None
  met = None if value is None else (value <= target if most else value >= target)
  return Row(question, value, len(given), f"{'<=' if most else '>='} {100 * target:.0f} %", met)


def _median(question: str, values: list[float], target: float) -> Row:
  value = float(np.median(values)) if values else None
  met = None if value is None else value <= target
  return Row(question, value, len(values), f"<= {target:g}", met)
