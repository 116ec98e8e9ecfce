"""What was named beside what was hidden: the table that a loop ends with."""

from collections.abc import Sequence
from typing import NamedTuple

from nerf2real.evaluation.loop.entering import CONSTANTS, LEARNED
from nerf2real.real.virtual import undeclared
from nerf2real.real.virtual.undeclared import Undeclared
from nerf2real.suite.effects import Effect, kind_of

# Effects of the library that are a right description of one that it lacks.
_DESCRIBED_BY = {
  "supply_course": ("supply_sag", "motor_gain"),
  "floor_slope": ("gravity_tilt",),  # of a robot that is held upright to the floor
}


class Row(NamedTuple):
  """A hidden effect and what was said of it."""

  hidden: str
  named: str  # empty: nothing was
  right: bool  # named by its name at its place; outside the library: nothing wrong is
  covered: bool | None  # whether every interval holds its value; None where there is none


class Comparison(NamedTuple):
  """What a loop named, judged."""

  rows: tuple[Row, ...]
  wrong: tuple[str, ...]  # named and not hidden
  in_reference: tuple[str, ...] = ()  # what the robot had before, too: its own build


def compare(
  hidden: Sequence[Undeclared], effects: Sequence[Effect], in_reference: Sequence[Effect] = ()
) -> Comparison:
  """Returns what was named of what was hidden, and what was named besides.

  Errors of declared constants and learned forces carry no name and are not judged.

  Args:
    hidden: What the robot had.
    effects: What identification found to have changed.
    in_reference: What it found that was there before, too; neither right nor wrong.
  """
  named = [e for e in effects if e.kind not in (*CONSTANTS, LEARNED)]
  rows, used = [], set()
  for item in hidden:
    matching = [e for e in named if _matches(item, e)]
    used |= {id(effect) for effect in matching}
    covered = None
    if undeclared.KINDS[item.kind].in_library and matching:
      covered = _covered(item, matching[0])
    in_library = undeclared.KINDS[item.kind].in_library
    rows.append(
      Row(
        hidden=str(item),
        named="; ".join(describe(e) for e in matching),
        right=bool(matching) or not in_library,
        covered=covered,
      )
    )
  wrong = tuple(describe(e) for e in named if id(e) not in used)
  return Comparison(tuple(rows), wrong, tuple(describe(e) for e in in_reference))


def describe(effect: Effect) -> str:
  """Returns an effect with its values, units and intervals in a line."""
  parts, kind = [], kind_of(effect.kind)
  for name, value in effect.parameters.items():
    if not isinstance(value, int | float):
      continue
    low, high = effect.intervals.get(name, (None, None))
    bounds = "" if low is None or high is None else f" ({low:.3g} to {high:.3g})"
    unit = kind.parameter(name).unit
    parts.append(f"{name} {value:.3g}{'' if unit == '1' else ' ' + unit}{bounds}")
  place = "" if effect.target is None else f" at {effect.target}"
  return f"{effect.kind}{place}: {', '.join(parts)}"


def _matches(hidden: Undeclared, effect: Effect) -> bool:
  if effect.kind not in (hidden.kind, *_DESCRIBED_BY.get(hidden.kind, ())):
    return False
  if hidden.target is None or hidden.kind == "floor_slope":
    return True
  return _joint(effect.target) == _joint(hidden.target)


def _joint(name: str | None) -> str:
  """Returns a joint's name; a link has the name of the joint that moves it."""
  return (name or "").removesuffix("_link")


def _covered(hidden: Undeclared, effect: Effect) -> bool | None:
  known = [
    (value, effect.intervals[name])
    for name, value in hidden.parameters.items()
    if name in effect.intervals
  ]
  return all(low <= value <= high for value, (low, high) in known) if known else None
