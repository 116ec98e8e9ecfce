"""What to record next: the motion that would tell the hypotheses apart that are still confounded.

Every design is simulated under the chosen hypothesis and under its rivals; the design in which the
readings differ most, in units of the sensor's noise, is proposed (Hunter and Reiner 1965).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model import kernel
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.measured import quantum
from nerf2real.sysid.model.plant import Simulated, Windows, simulated
from nerf2real.sysid.selection.search.evidence import Scored

Array = np.ndarray

_DURATION = 12.0  # s
_RATE = 50.0  # commands per second
_SAMPLES = 100.0  # readings per second
_RAMP = 0.5  # s, from the first measured position
_SLOW = 0.02  # of the top speed: less counts as standing, chosen
TIMES = np.arange(0.0, _DURATION - 0.02, 1.0 / _SAMPLES)
"""s of the readings under a design [S]."""


def designs(centre: float, reach: float, low: float, high: float) -> dict[str, Array]:
  """Returns commands [T] of each design, within [low, high] about the centre."""
  t = np.arange(0.0, _DURATION, 1.0 / _RATE)
  phase = 2 * np.pi * (0.2 * t + 0.5 * (3.0 - 0.2) / _DURATION * t**2)
  steps = np.array([0.8, -0.5, 0.3, -0.9, 0.6, -0.2, 1.0, -0.7])
  shapes = {
    "slow triangle, 0.08 Hz": 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 0.08 * t)),
    "slow triangle, 0.3 Hz": 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 0.3 * t)),
    "sweep, 0.2 to 3 Hz, full range": np.sin(phase),
    "sweep, 0.2 to 3 Hz, a fifth of the range": 0.2 * np.sin(phase),
    "steps of 1.5 s": steps[np.minimum((t / 1.5).astype(int), len(steps) - 1)],
    "reversals, small, 1 Hz": 0.08 * np.sign(np.sin(2 * np.pi * t)),
    "hold at the ends, 4 s each": np.where((t // 4) % 2 == 0, 1.0, -1.0),
  }
  ramp = np.minimum(t / _RAMP, 1.0)
  return {n: np.clip(centre + reach * ramp * s, low, high) for n, s in shapes.items()}


def designs_of(joint: JointLikelihood) -> dict[str, Array]:
  """Returns commands [T] of each design, over the positions that a joint's logs reach."""
  positions = np.concatenate([log.position for log in joint.plant.logs])
  centre, reach = float(np.median(positions)), 0.5 * float(np.ptp(positions))
  return designs(centre, reach, float(positions.min()), float(positions.max()))


def noise_of(joint: JointLikelihood) -> float:
  """Returns the noise of a joint's readings, at least their resolution."""
  positions = np.concatenate([log.position for log in joint.plant.logs])
  return max(quantum(positions), joint.position_noise)


def propose(joint: JointLikelihood, chosen: Scored, rivals: list[Scored]) -> dict[str, Any]:
  """Returns the design that separates the chosen hypothesis from its rivals best.

  Args:
    joint: its logs.
    chosen: hypothesis in the model.
    rivals: hypotheses that explain the logs nearly as well; empty: nothing to separate.
  """
  plant = joint.plant
  positions = np.concatenate([log.position for log in plant.logs])
  if not plant.holds:
    return {
      "joint": plant.joint,
      "design": "a longer log with forces of both signs, several sizes and pauses",
      "separates": [sorted(r.names) for r in rivals],
    }
  best: tuple[float, str] = (-1.0, "")
  noise = noise_of(joint)
  table = {}
  for name, command in designs_of(joint).items():
    truth, *others = (
      readings(plant, s.terms, s.fit.x, command).position for s in (chosen, *rivals)
    )
    gaps = [np.sqrt(np.mean((truth - other) ** 2)) for other in others]
    worst = float(min(gaps)) / noise if gaps else 0.0
    table[name] = round(worst, 2)
    if worst > best[0]:
      best = (worst, name)
  return {
    "joint": plant.joint,
    "design": best[1],
    "centre_rad": round(float(np.median(positions)), 3),
    "amplitude_rad": round(0.5 * float(np.ptp(positions)), 3),
    "separation_in_noise": table[best[1]],
    "all_designs": table,
    "separates": [sorted(r.names) for r in rivals],
  }


def compared(plant: JointModel, command: Array) -> dict[str, tuple[float, float]]:
  """Returns by quantity what the logs have, and what the declared model has under a design."""
  length, torque = ("rad", "torque [N m]") if plant.hinge else ("m", "force [N]")
  names = (
    f"top speed [{length}/s]",
    f"median speed [{length}/s]",
    f"range [{length}]",
    f"largest {torque}",
    "reversals a second",
  )
  position = np.concatenate([log.position for log in plant.logs])
  velocity = np.concatenate([log.velocity for log in plant.logs])
  duration = sum(float(log.time[-1] - log.time[0]) for log in plant.logs)
  here = _quantities(position, velocity, plant.declared_torque(), duration)
  under = readings(plant, (), np.zeros(0), command)
  speed = np.gradient(under.position, TIMES)
  there = _quantities(under.position, speed, under.torque, _DURATION)
  return dict(zip(names, zip(here, there, strict=True), strict=True))


def _quantities(position: Array, velocity: Array, torque: Array, duration: float) -> list[float]:
  """Returns top and median speed, range, largest torque and reversals a second of a motion."""
  speed = np.abs(velocity)
  moving = velocity[speed > _SLOW * speed.max()]
  reversals = np.sum(np.diff(np.sign(moving)) != 0) / duration
  found = (np.quantile(speed, 0.99), np.median(speed), np.ptp(position))
  return [float(value) for value in (*found, np.abs(torque).max(), reversals)]


def readings(plant: JointModel, terms: Sequence[Term], x: Array, command: Array) -> Simulated:
  """Returns readings [S] under a design at TIMES, surroundings at the joint's mean."""
  p, loads, table = compose(plant, terms, x)
  inertia, zero, quarter, _ = plant.forces(loads, 0)
  lift = plant.lift(0, float(p[kernel.INDEX["encoder_offset"]]))
  if lift is not None:
    zero, quarter = zero - lift[0], quarter - lift[1]
  count = int(_DURATION / plant.step) + 100
  means = (inertia.mean(), zero.mean(), quarter.mean(), 0.0, 0.0)
  fields = [np.full(count, mean) for mean in means]
  begin = Windows(np.array([0]), command[:1].copy(), np.zeros(1))
  times = (np.arange(len(command)) / _RATE, command, TIMES)
  none = np.full(len(TIMES), np.nan)
  return Simulated(*simulated(p, plant.step, times, fields, plant.hinge, begin, none, table))
