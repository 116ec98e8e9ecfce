"""Judges whether a stored result still holds of later logs: its error, and its values.

Nothing of the stored hypotheses is changed to predict. The logarithm of a log's RMSE is normal over
logs of one machine: that of n later logs is expected about the mean of the L stored ones within

    t_(J (L - 1)) s sqrt(1 / L + 1 / n)

s pooled over the J joints (prediction interval, e.g. Hahn and Meeker 1991, section 4.2), at least
what the scatter of blocks makes it. What the readings are noisier by is no drift and is taken off,
and what is less than half of their noise is none, as elsewhere (`settings.structured`).
Then the named values alone are fitted anew, each joint's constants within what two recordings of
one machine differ by, and compared with their stored intervals (`values.py`). All are judged at one
family-wise level.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.stats import t

from nerf2real.core.robot_logs.reading import COMMANDS, Log, LogError, moves
from nerf2real.sysid.drift.stored import Stored, StoredJoint, squares_by_log
from nerf2real.sysid.drift.values import Value, compare
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.selection.search.evidence import variance
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray

_TESTS = 2  # the errors and the values share the level


@dataclasses.dataclass(frozen=True)
class Error:
  """A joint's error on later logs."""

  joint: str
  unit: str
  """rad or m."""
  stored: float
  """RMSE of the stored logs, their geometric mean."""
  expected: float
  """The largest that is expected of these later logs."""
  later: float
  noise_stored: float
  noise_later: float

  grown: bool
  """Whether it is larger than expected, what the readings are noisier by taken off."""


@dataclasses.dataclass(frozen=True)
class Drift:
  """What later logs say of a stored result."""

  logs: tuple[str, ...]
  errors: tuple[Error, ...]
  values: tuple[Value, ...]
  not_judged: tuple[str, ...]
  """Effects that were named and are not compared, as sensors', and joints that do not move."""

  @property
  def grown(self) -> list[Error]:
    """Joints whose errors have grown."""
    return [error for error in self.errors if error.grown]

  @property
  def moved(self) -> list[Value]:
    """Values that their stored intervals do not hold any more."""
    return [value for value in self.values if value.state == "moved"]

  @property
  def holds(self) -> bool:
    """Whether the stored result still holds."""
    return not self.grown and not self.moved


def judge(stored: Stored, logs: Sequence[Log], *, settings: Settings = SETTINGS) -> Drift:
  """Returns what later logs say of a stored result.

  Args:
    stored: what was identified.
    logs: later ones, one or several.
    settings: level of significance, what two recordings of a machine differ by.

  Joints that do not move in the later logs are not judged.

  Raises:
    LogError: a log lacks a joint of the result, or none of its joints moves.
  """
  for log in logs:
    missing = [j.joint for j in stored.joints if j.joint not in log.commands.joints]
    if missing:
      raise LogError(
        f"{log.name} has no commands for {missing}: found {list(log.commands.joints)} in "
        f"{COMMANDS}, expected the joints of the stored result; record the same joints."
      )
  still = [j.joint for j in stored.joints if not moves(logs, j.joint)]
  if len(still) == len(stored.joints):
    raise LogError(
      f"Found no motion of {still} in {', '.join(log.name for log in logs)}, expected some: record "
      "the motions of the stored result."
    )
  stored = _without(stored, still)
  machine = Machine(stored.model, logs, window_s=settings.window_s)
  now = {
    item.joint: JointLikelihood(machine.joint(item.joint), settings=settings, follows=item.follows)
    for item in stored.joints
  }
  level = settings.level / _TESTS
  values, skipped = compare(stored, now, level=level, settings=settings)
  errors = _errors(stored.joints, now, level=level, settings=settings)
  skipped += tuple(f"{joint}, which does not move in these logs" for joint in still)
  return Drift(tuple(log.name for log in logs), errors, values, skipped)


def _without(stored: Stored, still: Sequence[str]) -> Stored:
  """Returns a stored result without some joints and what was named of them alone."""
  rows = [
    row
    for row in stored.content["effects"]
    if not set(row.get("evidence", {}).get("joints") or [row["joint"]]) <= set(still)
  ]
  joints = [item for item in stored.joints if item.joint not in still]
  return dataclasses.replace(stored, joints=joints, content=stored.content | {"effects": rows})


def _errors(
  joints: Sequence[StoredJoint],
  now: dict[str, JointLikelihood],
  *,
  level: float,
  settings: Settings,
) -> tuple[Error, ...]:
  """Returns every joint's error beside what is expected of it."""
  rows = [[np.array(log.squares) for log in item.logs] for item in joints]
  logs = len(rows[0])
  logarithms = np.array([[_logarithm(blocks) for blocks in row] for row in rows])  # [J, L]
  scatter = float(np.mean([_scatter(blocks) ** 2 for row in rows for blocks in row]))
  freedom = len(joints) * (logs - 1)
  if logs > 1:
    spread = max(float(np.mean(np.var(logarithms, axis=1, ddof=1))), scatter)
  else:  # how much motions differ is not known: blocks alone
    spread, freedom = scatter, sum(len(row[0]) - 1 for row in rows)
  result = []
  for item, values in zip(joints, logarithms, strict=True):
    joint = now[item.joint]
    later = squares_by_log(joint, item.terms, np.array(item.values))
    reach = np.sqrt(spread * (1.0 / logs + 1.0 / len(later)))
    reach *= float(t.isf(level / len(joints), freedom))
    noise, now_noise = item.noise, joint.position_noise
    size = float(np.exp(np.mean([_logarithm(blocks) for blocks in later])))
    expected = float(np.exp(values.mean() + reach))
    least = max(now_noise**2 - noise**2, 0.0) + (settings.structured * noise) ** 2
    result.append(
      Error(
        item.joint,
        item.unit,
        stored=float(np.exp(values.mean())),
        expected=expected,
        later=size,
        noise_stored=noise,
        noise_later=now_noise,
        grown=size**2 > expected**2 + least,
      )
    )
  return tuple(result)


def _logarithm(squares: Array) -> float:
  """Returns the logarithm of a log's RMSE, by its blocks [B]."""
  return 0.5 * float(np.log(max(squares.mean(), 1e-300)))


def _scatter(squares: Array) -> float:
  """Returns the standard error of the logarithm of a log's RMSE, by its blocks [B]."""
  if len(squares) < 2:
    return 0.0
  return 0.5 * float(np.sqrt(variance(squares)) / max(squares.sum(), 1e-300))
