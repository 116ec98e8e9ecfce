"""Which joints to look at: every joint's calibrated null model, ranked by what it leaves.

A race costs a minute a joint; the null model a second. Effects on one joint show in that joint
and, weakly, in its neighbours: geared servos isolate joints from each other.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.fit.fitting import Problem
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.plant import JointPlant, actuator_of
from nerf2real.sysid.model.reduction import Reduction
from nerf2real.sysid.selection import explanation, race
from nerf2real.sysid.selection.race import Entry


@dataclasses.dataclass
class Screened:
  """One joint with its null model."""

  joint: str
  problem: Problem
  calibration: Term
  declared: Entry
  null: Entry

  @property
  def excess(self) -> float:
    """What the null model leaves, nats above the noise.

    Constants that are far from where they are expected count: a stronger motor passes for a gain.
    """
    return race.above_floor(self.null) + race.deviation(self.null.fit)


def screen(
  model: mujoco.MjModel,
  logs: Sequence[Log],
  *,
  window_s: float = 0.5,
) -> list[Screened]:
  """Returns all commanded joints, the least explained first.

  Args:
    model: declared model.
    logs: logs to identify from.
    window_s: length of windows where an actuator does not hold position.
  """
  joints = [
    name
    for name in logs[0].commands.joints
    if actuator_of(model, name) >= 0 and all(name in log.commands.joints for log in logs)
  ]
  reductions = [Reduction(model, log) for log in logs]
  result = []
  for joint in joints:
    plant = JointPlant(model, joint, logs, reductions=reductions, window_s=window_s)
    problem = Problem(plant)
    term, declared, null = explanation.bare(problem, candidates.calibration(plant))
    result.append(Screened(joint, problem, term, declared, null))
  return sorted(result, key=lambda s: -s.excess)


def shared_spread(screened: Sequence[Screened], entry: Entry | None = None) -> float:
  """Returns how far this machine's constants are off, from what its joints agree on.

  With declared constants that are right, the prior of every constant narrows with that; this is
  what tells a friction that was added from one that was mis-declared.
  """
  values = []
  fits = [entry.fit] if entry is not None else [s.null.fit for s in screened]
  for fit in fits:
    found = fit.values("calibration")
    values += [found[n] for n in ("armature", "gain", "mass") if n in found]
  count = len(values)
  if not count:
    return 0.06
  mean_square = float(np.mean(np.square(np.clip(values, -0.15, 0.15))))
  # Shrunk towards 0.06 as if one such value had been seen.
  return float(np.clip(np.sqrt((count * mean_square + 0.3 * 0.06**2) / (count + 0.3)), 0.01, 0.1))
