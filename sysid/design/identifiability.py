"""What logs can show: effects that would be seen, those that look alike, what motion is missing.

Nothing is fitted: the declared model is driven by the logged commands. Units are the readings'
noise: an effect counts as shown where it changes the readings by the noise at values where the
search for it starts, and as told from another where what that one, at any size, leaves of it does.
Effects of several joints are judged at each of them.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.sysid.design import excitation
from nerf2real.sysid.design.information import Place, beside, information, of_logs, places
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.selection.joints.subject import own_library
from nerf2real.sysid.settings import Settings

Array = np.ndarray

_EQUAL = 1.01  # times the mildest size: as mild

Open = frozenset[tuple[str, str]]
"""Kinds that are hidden, (kind, ""), and those not told from another, (kind, other)."""


@dataclasses.dataclass(frozen=True)
class Shown:
  """One kind of effect, as logs show it."""

  kind: str
  information: float
  """Of the values at which it shows best; 1: a change of the size of the noise."""
  visible: dict[str, float]
  """Sizes at which it would change the readings by their noise; empty where none in its bounds."""
  nearest: str | None
  """The kind that imitates it best."""
  cosine: float
  """Of the angle to that kind; 1: the same."""
  told: dict[str, float]
  """Sizes from which it would be told from that kind; empty where none in its bounds."""
  alike: tuple[str, ...]
  """Kinds that it would not be told from at the mildest values at which it is seen."""

  @property
  def shown(self) -> bool:
    """Whether it would be seen."""
    return self.information >= 1.0

  @property
  def lacks(self) -> Open:
    """What is open of it."""
    return frozenset((self.kind, other) for other in (self.alike if self.shown else ("",)))


@dataclasses.dataclass(frozen=True)
class Identifiability:
  """What the logs of one joint can show."""

  joint: str
  effects: tuple[Shown, ...]
  resolved: dict[str, list[tuple[str, str]]]
  """By motion: what it would show, (kind, ""), or tell apart, that the logs do not."""
  covered: dict[str, tuple[float, float]]
  """Of the best motion: by quantity, what the logs have and what that motion has."""

  @property
  def hidden(self) -> list[str]:
    """Kinds that these logs would not show."""
    return [e.kind for e in self.effects if not e.shown]

  @property
  def pairs(self) -> list[tuple[str, str]]:
    """Kinds that each imitate the other; a wider kind that holds a narrower one is no pair."""
    return _pairs(frozenset().union(*(e.lacks for e in self.effects)))

  @property
  def motion(self) -> str | None:
    """The motion that resolves most of what is open; None where none resolves anything."""
    best = max(self.resolved, key=lambda name: len(self.resolved[name]), default=None)
    return best if best is not None and self.resolved[best] else None


def of_machine(
  machine: Machine,
  *,
  repeated: bool,
  settings: Settings,
  progress: Progress = no_progress,
) -> list[Identifiability]:
  """Returns what logs can show of every joint that all of them command and that moves, before
  anything is fitted.

  Args:
    machine: the declared model along the logs to identify from.
    repeated: whether reference logs tell the constants, so that they vary by `settings.repeat`.
    settings: tolerances.
    progress: called with the fraction done and a text.
  """
  joints = machine.moving()
  if repeated:
    settings = dataclasses.replace(settings, tolerances=settings.repeat)
  result = []
  for k, joint in enumerate(joints):
    progress(k / len(joints), f"what the logs can show of {joint}, {k + 1} of {len(joints)} joints")
    plant = machine.joint(joint)
    library = own_library(plant, alone=len(joints) == 1)
    result.append(identifiability(JointLikelihood(plant, settings=settings), library))
  return result


def identifiability(joint: JointLikelihood, library: Sequence[Term]) -> Identifiability:
  """Returns what the logs of a joint can show of the effects of a library.

  Args:
    joint: its logs; nothing is fitted.
    library: effects.
  """
  own, chosen = constants(joint.plant, joint.settings), places(library)
  matrix = of_logs(joint, own, chosen)
  effects = _judged(chosen, matrix)
  lacking = _open(effects)
  result = Identifiability(joint.plant.joint, tuple(effects), {}, {})
  if not lacking or not joint.plant.holds:
    return result
  commands = excitation.designs_of(joint)
  few = [place for place in chosen if any(place.kind in entry for entry in lacking)]
  for name, command in commands.items():
    result.resolved[name] = _resolved(joint, own, few, command, lacking)
  if result.motion is not None:
    result.covered.update(excitation.compared(joint.plant, commands[result.motion]))
  return result


def _resolved(
  joint: JointLikelihood, own: Term, chosen: Sequence[Place], command: Array, lacking: Open
) -> list[tuple[str, str]]:
  """Returns what a log of a motion alone would show, or tell apart, of what is open."""
  matrix = information(
    lambda terms, x: excitation.readings(joint.plant, terms, x, command).position[None],
    own,
    chosen,
    noise=np.array([excitation.noise_of(joint)]),
    count=len(excitation.TIMES),
  )
  there = _judged(chosen, matrix)
  left, seen = _open(there), {e.kind for e in there if e.shown}
  return sorted(e for e in lacking - left if set(filter(None, e)) <= seen)


def _open(effects: Sequence[Shown]) -> Open:
  """Returns what is hidden, and the pairs that are not told apart."""
  lacks: Open = frozenset().union(*(e.lacks for e in effects))
  return frozenset(e for e in lacks if not e[1]) | frozenset(_pairs(lacks))


def _pairs(lacks: Open) -> list[tuple[str, str]]:
  return sorted((a, b) for a, b in lacks if a < b and (b, a) in lacks)


def _judged(chosen: Sequence[Place], matrix: Array) -> list[Shown]:
  """Returns what an information matrix [K, K] says of every kind."""
  of_kind: dict[str, list[int]] = {}
  for at, place in enumerate(chosen):
    of_kind.setdefault(place.kind, []).append(at)
  own = np.diag(matrix)
  result = []
  for kind, mine in of_kind.items():
    seen = [at for at in mine if own[at] >= 1.0]
    mild = min((chosen[at].distance for at in seen), default=0.0)
    mildest = [at for at in seen if chosen[at].distance <= _EQUAL * mild]
    rivals = {other: of_other for other, of_other in of_kind.items() if other != kind}
    left = {o: {at: beside(matrix, at, r) for at in mine} for o, r in rivals.items()}
    alike = [o for o in left if mildest and max(left[o][at] for at in mildest) < 1.0]
    best = max(mine, key=lambda at: own[at])
    nearest = min(left, key=lambda other: left[other][best], default=None)
    rest = np.array([left[nearest][at] for at in mine]) if nearest else own[mine]
    ratio = rest[mine.index(best)] / max(own[best], 1e-300)
    result.append(
      Shown(
        kind,
        float(own[best]),
        _sizes([chosen[at] for at in mine], own[mine]),
        nearest,
        round(float(np.sqrt(max(1.0 - ratio, 0.0))), 4),
        _sizes([chosen[at] for at in mine], rest),
        tuple(alike),
      )
    )
  return result


def _sizes(mine: Sequence[Place], information: Array) -> dict[str, float]:
  """Returns the smallest sizes of a kind with information 1, by its places' information [K]."""
  if not mine[0].scales:  # of a threshold: the mildest that is seen
    seen = [place for place, f in zip(mine, information, strict=True) if f >= 1.0]
    return seen[0].sizes() if seen else {}
  shares = 1.0 / np.sqrt(np.maximum(information, 1e-12))
  found = [place.sizes(float(share)) for place, share in zip(mine, shares, strict=True)]

  best = min(range(len(mine)), key=lambda at: shares[at] * mine[at].distance)
  bounds = dict(
    zip(
      mine[best].term.names,
      zip(mine[best].term.low, mine[best].term.high, strict=True),
      strict=True,
    )
  )
  inside = all(bounds[n][0] <= value <= bounds[n][1] for n, value in found[best].items())
  return found[best] if inside else {}
