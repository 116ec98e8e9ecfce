"""How a position servo's readings follow its commands: a regression, without a simulation.

Shapes: N readings, L lags.
"""

from typing import NamedTuple

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import MINIMUM_MOTION, Log
from nerf2real.sysid.model.drive import actuator_of, holds_position

Array = np.ndarray

_LAGS = np.arange(-0.1, 0.5001, 0.005)
"""s that readings are looked for behind their commands; below 0 they come before them. Chosen: the
weakest measured servo, an XL330 at a gain of 100, is 0.27 s behind."""
_BEGINNING = 0.5  # s that are left out: a joint may begin elsewhere than it is commanded
_FEWEST, _MOST = 50, 4000  # readings; chosen: half a second at 100 Hz, and of more every n-th


class Fit(NamedTuple):
  """Readings as slope times the commands of a lag before, and a constant."""

  slope: float
  share: float
  """Of the readings' variance that is explained."""
  lag: float
  """s."""
  offset: float
  """Median of readings less commands, rad or m."""


class Following(NamedTuple):
  """The best fits of one joint in one log."""

  along: Fit
  """With a positive slope; a share of 0 where no lag has one."""
  against: Fit
  """With a negative slope."""
  prompt: float
  """Share that is explained with a lag of 0."""

  @property
  def best(self) -> Fit:
    """The one that explains more."""
    return max(self.along, self.against, key=lambda fit: fit.share)


_NONE = Fit(0.0, 0.0, 0.0, 0.0)


def servos(log: Log, model: mujoco.MjModel) -> list[str]:
  """Returns the joints that a log commands by position."""
  if log.commands.position is None:
    return []
  return [j for j in log.commands.joints if holds_position(model, actuator_of(model, j))]


def target(log: Log, model: mujoco.MjModel, joint: str) -> Array:
  """Returns where a position servo's commands would hold its joint without a load [M], rad or m."""
  assert log.commands.position is not None
  u = actuator_of(model, joint)
  gear, gain = float(model.actuator_gear[u, 0]), float(model.actuator_gainprm[u, 0])
  constant, per_position = (float(value) for value in model.actuator_biasprm[u, :2])
  told: Array = log.commands.position[:, log.commands.column(joint)]
  return (gain * told + constant) / (-per_position * gear)


def following(log: Log, model: mujoco.MjModel, joint: str) -> Following | None:
  """Returns how a joint follows its commands; None where it or they do not move.

  Args:
    log: measured.
    model: declared.
    joint: with a position servo.
  """
  assert log.states.position is not None
  stamp, commanded = log.states.stamp, log.commands.stamp
  inside = np.flatnonzero((stamp >= commanded[0] + _BEGINNING) & (stamp <= commanded[-1]))
  inside = inside[:: max(1, len(inside) // _MOST)]
  read = log.states.position[inside, log.states.column(joint)]
  told = target(log, model, joint)
  if len(read) < _FEWEST or np.ptp(read) <= MINIMUM_MOTION or not np.ptp(told) > MINIMUM_MOTION:
    return None
  at = np.searchsorted(commanded, stamp[inside] - _LAGS[:, None], side="right") - 1
  wanted = told[np.clip(at, 0, None)]  # [L, N]
  apart, moved = wanted - wanted.mean(axis=1, keepdims=True), read - read.mean()
  power, total = np.sum(apart**2, axis=1), float(moved @ moved)
  cross = apart @ moved
  slope = cross / np.maximum(power, 1e-12)
  share = slope * cross / total

  def best(those: Array) -> Fit:
    if not those.any():
      return _NONE
    n = int(np.argmax(np.where(those, share, -1.0)))
    offset = float(np.median(read - wanted[n]))
    return Fit(float(slope[n]), float(share[n]), float(_LAGS[n]), offset)

  prompt = float(share[int(np.argmin(np.abs(_LAGS)))])
  return Following(best(slope > 0.0), best(slope < 0.0), prompt)
