"""What the logs can show, whatever was found: in a sentence, and as a section of the report."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.core.pages.blocks import Block, Details, Heading, Table, Text
from nerf2real.core.pages.page import Section
from nerf2real.sysid.design.identifiability import Identifiability, Shown

_HEADER = [
  "effect",
  "changes the readings by [noise]",
  "seen from",
  "most like",
  "cosine",
  "told from it from",
]
_NAMED = 3  # joints that are named one by one
_OPEN = 3  # joints whose tables are shown at once


_READ = (
  "Before any fit: how much an effect of a usual size would change the readings of the declared"
  " model under the logged commands, less what the constants imitate within their tolerances; the"
  " size (SI units) from which that is as large as the readings' noise; the effect that imitates it"
  " best, and the size from which the two differ by the noise."
)


def section(shown: Sequence[Identifiability]) -> Section:
  """Returns the section."""
  blocks: list[Block] = []
  for at, item in enumerate(shown):
    table = Table(_HEADER, [_row(effect) for effect in item.effects])
    motions = [[name, deeds(entries)] for name, entries in item.resolved.items() if entries]
    parts: list[Block] = [table]
    if motions:
      parts += [Heading("Motions that would show more"), Table(["motion", "would"], motions)]
    if item.covered:
      rows = [[name, *values] for name, values in item.covered.items()]
      parts += [Table(["", "these logs", str(item.motion)], rows)]
    if at < _OPEN:
      blocks += [Heading(item.joint), *parts]
    else:
      blocks.append(Details(item.joint, parts))
  return Section("What these logs can show", sentence(shown), [Text(_READ), *blocks])


def _row(effect: Shown) -> list[Any]:
  size = float(effect.information**0.5)
  nearest = effect.nearest or ""
  return [
    effect.kind,
    size,
    _sizes(effect.visible),
    nearest,
    effect.cosine if nearest else "",
    _sizes(effect.told) if nearest else "",
  ]


def _sizes(sizes: dict[str, float]) -> str:
  """Returns sizes in words."""
  return ", ".join(f"{name} {value:.3g}" for name, value in sizes.items()) or "no usual size"


def sentence(found: Sequence[Identifiability]) -> str:
  """Returns what the logs of a machine's joints can show, in a line or two."""
  everywhere = len(found)
  hidden = _counted([(kind, item.joint) for item in found for kind in item.hidden], everywhere)
  pairs = [(" and ".join(pair), item.joint) for item in found for pair in item.pairs]
  alike = _counted(pairs, everywhere)
  words = f"Of {len({e.kind for item in found for e in item.effects})} kinds of effect these logs"
  words += f" would not show, at usual sizes, {hidden}" if hidden else " would show all"
  words += f", and not tell apart {alike}." if alike else "."
  resolved: dict[str, list[tuple[str, str]]] = {}
  for item in found:
    for name, entries in item.resolved.items():
      resolved.setdefault(name, []).extend(entries)
  best = max(resolved, key=lambda name: len(resolved[name]), default="")
  if not resolved.get(best):
    return words
  covered = next((item.covered for item in found if item.motion == best), {})
  words += f' The motion "{best}" would {deeds(resolved[best])}'
  return words + (f" ({_difference(covered)})." if covered else ".")


def _counted(entries: Sequence[tuple[str, str]], everywhere: int) -> str:
  """Returns names with the joints that they are of, where that is not all of them."""
  joints: dict[str, list[str]] = {}
  for name, joint in entries:
    joints.setdefault(name, []).append(joint)
  words = []
  for name, where in joints.items():
    few = ", ".join(where) if len(where) <= _NAMED else f"{len(where)} joints"
    words.append(name if len(where) == everywhere else f"{name} (at {few})")
  return ", ".join(words)


def deeds(resolved: Sequence[tuple[str, str]]) -> str:
  """Returns what a motion would do, in words."""
  shows = [kind for kind, other in dict.fromkeys(resolved) if not other]
  tells = [f"{a} from {b}" for a, b in dict.fromkeys(resolved) if b]
  parts = [f"show {', '.join(shows)}"] if shows else []
  return " and ".join([*parts, f"tell {', '.join(tells)}"] if tells else parts)


def _difference(covered: dict[str, tuple[float, float]]) -> str:
  """Returns the quantity in which a motion differs most from the logs, in words."""

  def ratio(name: str) -> float:
    here, there = covered[name]
    return abs(float(np.log(max(there, 1e-9) / max(here, 1e-9))))

  name = max(covered, key=ratio)
  return f"{name}: {covered[name][0]:.2g} in these logs, {covered[name][1]:.2g} there"
