"""What only walking shows: friction under weight and slip, from recorded walks simulated again.

A joint that hangs in the air carries little, and a held foot slides on nothing. Walks of before and
after are simulated again (`replay`), each with what is known by then. What the model leaves of the
walks of before is expected of the later ones, too:

    r = y - f(effect) - b,    b = mean(y - f) of the walks of before

Nothing is looked for where the later walks leave no more than a multiple of what those of before
do. An effect is named where it leaves less than no effect and than every other one does, beyond the
scatter from walk to walk (a paired t-test at a level for all together), and explains more than it
leaves. Weak motors are among the others; they are named from the air, not here.

Shapes: K walks, D figures of a walk.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy import stats

from nerf2real.suite.effects import Effect, kind_of
from nerf2real.sysid.sensors import standing
from nerf2real.sysid.sensors.sensed import Part, row
from nerf2real.sysid.sensors.walks.fitting import Candidate, Found, Judge, apart, best_first
from nerf2real.sysid.sensors.walks.replay import Replay, Walk, measured
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

_FEWEST = 4  # walks of before and of now: less do not tell their own scatter
_MOST = 12  # walks that are simulated; chosen: time
_SENSOR = "walking"


class Recordings(NamedTuple):
  """Walks, and what the model has when they were recorded."""

  walks: Sequence[Walk]
  effects: Sequence[Effect]


def find(model: mujoco.MjModel, root: int, now: Recordings, before: Recordings) -> Part:
  """Returns what walks show that those of before did not.

  Args:
    model: with a floor, and a free body with an IMU.
    root: that body.
    now: walks to explain, with the effects that are known of the robot.
    before: walks of the same robot from before, with the effects that it had then.
  """
  part = Part()
  chosen, earlier = _chosen(now.walks), _chosen(before.walks)
  if min(len(chosen), len(earlier)) < _FEWEST:
    part.notes.append(
      f"Found {len(chosen)} walks that are long enough, and {len(earlier)} from before, expected "
      f"{_FEWEST} of both: friction under weight and slip are not looked at."
    )
    return part
  missed = _missed(model, root, earlier, before.effects)
  judge = Judge(np.stack([measured(walk) for walk in chosen]), missed)
  replay = Replay(model, now.effects, root)
  nothing = np.stack([replay.figures(walk) for walk in chosen])
  alone = judge.left(nothing)
  part.before, part.after = float(alone.mean()), float(alone.mean())
  if alone.mean() <= SETTINGS.more * judge.usual:
    return part

  def simulated(candidate: Candidate, value: float) -> Array:
    changed = Replay(model, [*now.effects, candidate.effect(value)], root)
    return np.stack([changed.figures(walk) for walk in chosen])

  listed = candidates(model, replay.bearing(chosen[0]), now.effects)
  found = best_first(simulated, listed, nothing, judge)
  _write(part, found, alone, judge.usual, len(listed))
  return part


def candidates(
  model: mujoco.MjModel, joints: Sequence[str], known: Sequence[Effect]
) -> list[Candidate]:
  """Returns the effects that walks may show, of joints that bear weight; none that is known."""
  taken = {(effect.kind, effect.target) for effect in known}
  found = [
    Candidate("floor_friction", standing.floor(model), "scale", 1.0, (0.4, 0.2, 0.1)),
    Candidate("load_friction", None, "coefficient", 0.0, (0.1, 0.2, 0.4)),
  ]
  for joint in joints:
    found.append(Candidate("load_friction", joint, "coefficient", 0.0, (0.15, 0.3, 0.6)))
    found.append(Candidate("motor_gain", joint, "gain", 1.0, (0.7, 0.5, 0.3), named=False))
  return [c for c in found if (c.kind, c.target) not in taken]


def _chosen(walks: Sequence[Walk]) -> list[Walk]:
  """Returns walks that are long enough, spread over all."""
  long = [walk for walk in walks if walk.is_long]
  at = np.unique(np.linspace(0, len(long) - 1, min(_MOST, len(long))).round().astype(int))
  return [long[k] for k in at]


def _missed(
  model: mujoco.MjModel, root: int, walks: Sequence[Walk], effects: Sequence[Effect]
) -> Array:
  """Returns what the model leaves of walks [K, D]."""
  replay = Replay(model, effects, root)
  return np.stack([measured(walk) - replay.figures(walk) for walk in walks])


def _write(part: Part, found: Sequence[Found], alone: Array, usual: float, tried: int) -> None:
  """Adds what is named to a part, or why nothing is.

  Args:
    part: To be added to.
    found: What was tried, the one that leaves least first.
    alone: What is left of each walk [K] without any.
    usual: What is left of a walk of before.
    tried: How many were.
  """
  best, count = found[0], len(alone)
  clear = float(stats.t.ppf(1 - SETTINGS.level / tried, count - 1))
  after = float(best.left.mean())
  seen = (
    f"Walks are off what the model makes of their commands by {alone.mean():.1f} times the "
    f"variance of those of before ({usual:.1f} is usual);"
  )
  explains = alone.mean() - after > after - usual  # more than it leaves
  if apart(alone, best.left) < clear or not explains:
    part.notes.append(f"{seen} no effect explains it: {_name(best.candidate)} leaves {after:.1f}.")
    return
  part.after = after
  # 95 %, wider by what remains (Birge 1932).
  reach = float(stats.t.ppf(0.975, count - 1) * np.sqrt(max(1.0, after / usual)))
  like = [f for f in found if apart(f.left, best.left) < clear]
  rows = [_row(f, alone, reach) for f in like]
  names = " or ".join(_name(f.candidate) for f in like)
  part.notes.append(f"{seen} {names} leaves {after:.1f}.")
  if len(like) == 1 and best.candidate.named:
    part.rows += rows
  else:
    part.alternatives += rows


def _name(candidate: Candidate) -> str:
  return candidate.kind + (f" at {candidate.target}" if candidate.target else "")


def _row(found: Found, alone: Array, reach: float) -> dict[str, Any]:
  """Returns a candidate's entry in the report."""
  made = found.candidate
  least = kind_of(made.kind).parameter(made.parameter).minimum
  low = max(found.value - reach * found.spread, least)
  bounds = (found.value, float(low), float(found.value + reach * found.spread))
  gain = float((np.log1p(alone) - np.log1p(found.left)).sum())
  entry = row(made.kind, _SENSOR, {made.parameter: bounds}, gain, gain)
  place = "geom" if made.kind == "floor_friction" else "joint"
  return {**entry, place: made.target}
