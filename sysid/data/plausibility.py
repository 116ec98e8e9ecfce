"""Finds what is wrong with logs whatever the machine is: units, signs, turns, stamps, lost values.

No healthy or faulty machine does what is refused here: a servo follows its commands with a slope
between 0 and some more than 1, behind them, and about where it is told to be.

Shapes: N readings.
"""

import collections
from collections.abc import Iterable, Sequence

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import MINIMUM_MOTION, Log
from nerf2real.core.robot_logs.streaming import LogError
from nerf2real.sysid.data.following import Following, following, servos, target
from nerf2real.sysid.model.measured import quantum
from nerf2real.sysid.model.motion import smooth_motion

Array = np.ndarray

_TURN = 2.0 * np.pi
_CLEAR = 0.8  # share of the readings' variance from which on commands tell them; chosen
_NOT = 0.5  # of the share with the other sign, below which a sign is not the right one; chosen
_ONE = (0.3, 2.0)  # slopes of servos as they are, weak ones and such that overshoot; chosen
_NEAR_ONE = (0.7, 1.5)  # of servos that are about where they are told to be; chosen
_DEGREES = (20.0, 170.0)  # of readings in degrees of commands in radians: 57.3, within thrice
_RADIANS = (1 / 170.0, 1 / 20.0)  # the other way round
_FAR = 2.0 * _TURN  # rad of motion; servos of arms and legs stay within two turns; chosen
_FAST = 100.0  # rad/s, 950 rpm: faster than joints of robots, not than all machines; chosen
_OFF_TURN = 0.5  # rad between an offset and whole turns, of gravity's sag; chosen
_EARLY = 0.01  # s before its command that a reading cannot come; two steps of the lags
_WORSE = 1.5  # times what a lag of 0 leaves of what one before it does; chosen
_SURE = 0.95  # share that commands tell where a lag is read off; chosen
_SAME_STAMPS = 0.1  # share of readings with the stamp of another that makes a log useless; chosen
_SPIKE = (5.0, 20.0, 0.02, 3.0)
"""Times the motion around, the noise, the range and the resolution: a single reading that leaves
and returns by more than all of them was not read. Chosen."""
_SETTLED = 1.0  # s after its last command by which a servo's joint has settled; chosen
_MOVING = 0.2  # of its motion before, beyond which it has not; chosen
_FEW = 4  # joints that are named; more are counted


def check_units(log: Log, model: mujoco.MjModel, joint: str) -> None:
  """Raises a LogError where a joint's readings or commands are in degrees.

  Args:
    log: measured.
    model: declared.
    joint: that the log commands.
  """
  index = model.joint(joint).id
  hinge = int(model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_HINGE)
  if not hinge or joint not in servos(log, model):
    return
  found = following(log, model, joint)
  if found is None:
    return
  slope, share = abs(found.best.slope), found.best.share
  told = target(log, model, joint)
  where = ""
  if share > _CLEAR and _within(slope, _DEGREES):
    where = f"its readings are {slope:.3g} times its commands: the readings are in degrees"
  elif share > _CLEAR and _within(slope, _RADIANS) and np.ptp(told) > _FAR:
    where = f"its readings are 1/{1 / slope:.3g} of its commands: the commands are in degrees"
  elif model.jnt_limited[index] and _within(slope, _ONE):
    times = float(np.ptp(told)) / float(np.ptp(model.jnt_range[index]))
    if times > _DEGREES[0]:
      where = (
        f"it is told to go over {times:.0f} times its range: commands and readings are in degrees"
      )
  if where:
    raise LogError(
      f"{log.name}: {where} at {joint!r}, expected radians: convert them, or name the unit in the "
      f"header of a CSV, such as `position:{joint} [deg]`."
    )


def check_plausible(logs: Sequence[Log], model: mujoco.MjModel) -> None:
  """Raises a LogError where logs cannot be right: stamps of the writing, readings of the other sign
  at all servos, or whole turns off.

  Args:
    logs: of one machine, checked against the model.
    model: declared.
  """
  for log in logs:
    same = float(np.mean(np.diff(log.states.stamp) == 0.0))
    if same > _SAME_STAMPS:
      raise LogError(
        f"{log.name}: {same:.0%} of the readings have the stamp of the one before, expected a "
        "stamp each: stamps are of the writing, not of the reading; stamp each when it is read."
      )
  found = _all(logs, model)
  flipped = _flipped(found)
  judged = {joint for _, joint, item in found if item.best.share > _CLEAR}
  if flipped and set(flipped) >= judged:
    raise LogError(
      f"{flipped[next(iter(flipped))]}: readings of {_some(flipped)} go against their commands, "
      "expected readings that follow them: one of the two has the other sign, so turn the sign of "
      "the readings, or of the commands, to that of the model's joint."
    )
  for name, joint, item in found:
    fit, hinge = item.along, int(model.joint(joint).type[0]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    turns = round(fit.offset / _TURN)
    near = abs(fit.offset - turns * _TURN) < _OFF_TURN
    if hinge and turns and near and fit.share > _CLEAR and _within(fit.slope, _NEAR_ONE):
      raise LogError(
        f"{name}: readings of {joint!r} lie {fit.offset:.3g} rad from their commands, {turns:+d} "
        f"times 2 pi, expected readings where the servo is told to be: take {turns * _TURN:.4g} "
        "off them."
      )


def doubts(logs: Sequence[Log], model: mujoco.MjModel) -> list[str]:
  """Returns sentences on what is wrong with logs that can be used nevertheless.

  Args:
    logs: of one machine, checked against the model.
    model: declared.
  """
  found = _all(logs, model)
  flipped = _flipped(found)
  texts = []
  if flipped:
    texts.append(
      f"{flipped[next(iter(flipped))]}: readings of {_some(flipped)} go against their commands, and"
      " those of other joints follow theirs: one of the two has the other sign there. Turn it."
    )
  early: dict[str, dict[str, float]] = collections.defaultdict(dict)
  for name, joint, item in found:
    fit = item.along
    left = max(1.0 - fit.share, 1e-12)
    if fit.share > _SURE and fit.lag <= -_EARLY and 1.0 - item.prompt > _WORSE * left:
      early[name][joint] = fit.lag
  for name, lags in early.items():
    texts.append(
      f"{name}: readings of {_some(lags)} come up to {-1e3 * min(lags.values()):.0f} ms before the"
      " commands that they follow, which no machine does: the clocks or stamps of commands and"
      " readings differ. Stamp both by one clock, a command when it is sent and a reading when it"
      " is read."
    )
  for log in logs:
    texts += [*_fast(log, model), *_lost(log), *_ended(log, model)]
  return texts


def _all(logs: Sequence[Log], model: mujoco.MjModel) -> list[tuple[str, str, Following]]:
  """Returns how joints follow that move, each with its log's name and its own."""
  found = [
    (log.name, joint, following(log, model, joint)) for log in logs for joint in servos(log, model)
  ]
  return [(name, joint, item) for name, joint, item in found if item is not None]


def _flipped(found: Sequence[tuple[str, str, Following]]) -> dict[str, str]:
  """Returns joints whose readings go against their commands, with the first log that shows it: by
  far better than they follow them at any lag, as a delay of half a period is no other sign."""
  against: dict[str, str] = {}
  along = set()
  for name, joint, item in found:
    if item.along.share > _CLEAR:
      along.add(joint)
    elif (
      item.against.share > _CLEAR
      and item.along.share < _NOT * item.against.share
      and _within(-item.against.slope, _ONE)
    ):
      against.setdefault(joint, name)
  return {joint: name for joint, name in against.items() if joint not in along}


def _fast(log: Log, model: mujoco.MjModel) -> list[str]:
  """Returns a sentence on hinges so fast over so many turns that they may be in degrees."""
  assert log.states.position is not None
  speeds: dict[str, float] = {}
  for joint in servos(log, model):
    column = log.states.column(joint)
    hinge = int(model.joint(joint).type[0]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    if hinge and np.ptp(log.states.position[:, column]) > _FAR:
      top = float(np.quantile(np.abs(smooth_motion(log).velocity[:, column]), 0.99))
      speeds |= {joint: top} if top > _FAST else {}
  if not speeds:
    return []
  return [
    f"{log.name}: {_some(speeds)} move at up to {max(speeds.values()):.0f} rad/s over more than two"
    " turns: if commands and readings are in degrees, convert them, or name the unit in the header"
    " of a CSV."
  ]


def _lost(log: Log) -> list[str]:
  """Returns a sentence on single readings that leave the motion around them and return."""
  assert log.states.position is not None
  counts, values = {}, []
  for joint, read in zip(log.joints, log.states.position.T, strict=True):
    at = spikes(read)
    if len(at):
      counts[joint] = len(at)
      values += list(read[at])
  if not counts:
    return []
  same = f", all at {values[0]:.4g}" if np.ptp(values) == 0.0 and len(values) > 1 else ""
  return [
    f"{log.name}: {sum(counts.values())} single readings of {_some(counts)} leave the motion around"
    f" them and return{same}: they were not read. Leave out what could not be read, in place of"
    " another number."
  ]


def spikes(read: Array) -> Array:
  """Returns which readings [N] of a joint leave the motion around them and return."""
  if len(read) < 5:
    return np.zeros(0, int)
  step = np.diff(read)
  leaves, returns = step[1:-2], step[2:-1]  # of the readings 2 to N - 3
  jump = np.where(leaves * returns < 0.0, np.minimum(np.abs(leaves), np.abs(returns)), 0.0)
  around = np.maximum.reduce([np.abs(step[:-3]), np.abs(step[3:]), np.abs(leaves + returns)])
  noise = float(np.median(np.abs(np.diff(read, n=3)))) / np.sqrt(20.0)
  extent = float(np.ptp(np.quantile(read, (0.02, 0.98))))
  sizes = (around, noise, extent, quantum(read))
  beyond = [jump > k * size for k, size in zip(_SPIKE, sizes, strict=True)]
  return np.flatnonzero(np.all(beyond, axis=0) & (jump > MINIMUM_MOTION)) + 2


def _ended(log: Log, model: mujoco.MjModel) -> list[str]:
  """Returns a sentence on joints that go on moving after their servos' last command."""
  assert log.states.position is not None
  last = float(log.commands.stamp[-1])
  after = log.states.stamp > last + _SETTLED
  if np.count_nonzero(after) < 2:
    return []
  moving = []
  for joint in servos(log, model):
    read = log.states.position[:, log.states.column(joint)]
    before = read[log.states.stamp <= last]
    if np.ptp(read[after]) > max(_MOVING * np.ptp(before), 10.0 * quantum(read), MINIMUM_MOTION):
      moving.append(joint)
  if not moving:
    return []
  return [
    f"{log.name}: commands end at {last:.2f} s, while {_some(moving)} go on moving until"
    f" {log.states.stamp[-1]:.2f} s: what moves them then is not in the log. Record commands to the"
    " end, or cut the log where they end."
  ]


def _within(value: float, bounds: tuple[float, float]) -> bool:
  return bounds[0] < value < bounds[1]


def _some(joints: Iterable[str]) -> str:
  """Returns joints in words."""
  names = list(joints)
  more = f" and {len(names) - _FEW} more" if len(names) > _FEW else ""
  return ", ".join(names[:_FEW]) + more
