"""What to record next: the motion that would tell the hypotheses apart that are still confounded.

Every design is simulated under the chosen hypothesis and under its rivals; the design in which the
readings differ most, in units of the sensor's noise, is proposed (Hunter and Reiner 1965).
"""

from typing import Any

import numpy as np

from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.model import kernel
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.measured import quantum
from nerf2real.sysid.selection.explain import Scored

Array = np.ndarray

_DURATION = 12.0  # s
_RATE = 50.0  # commands per second
_SAMPLES = 100.0  # readings per second
_RAMP = 0.5  # s, from the first measured position


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


def propose(joint: JointLikelihood, chosen: Scored, rivals: list[Scored]) -> dict[str, Any]:
  """Returns the design that separates the chosen hypothesis from its rivals best.

  Args:
    joint: its logs.
    chosen: hypothesis in the model.
    rivals: hypotheses that explain the logs nearly as well; empty: nothing to separate.
  """
  plant = joint.plant
  positions = np.concatenate([log.position for log in plant.logs])
  centre, reach = float(np.median(positions)), 0.5 * float(np.ptp(positions))
  if not plant.holds:
    return {
      "joint": plant.joint,
      "design": "a longer log with forces of both signs, several sizes and pauses",
      "separates": [sorted(r.names) for r in rivals],
    }
  best: tuple[float, str] = (-1.0, "")
  noise = max(quantum(positions), joint.position_noise)
  table = {}
  for name, command in designs(
    centre, reach, float(positions.min()), float(positions.max())
  ).items():
    truth = _readings(joint.plant, chosen, command)
    gaps = [np.sqrt(np.mean((truth - _readings(joint.plant, r, command)) ** 2)) for r in rivals]
    worst = float(min(gaps)) / noise if gaps else 0.0
    table[name] = round(worst, 2)
    if worst > best[0]:
      best = (worst, name)
  return {
    "joint": plant.joint,
    "design": best[1],
    "centre_rad": round(centre, 3),
    "amplitude_rad": round(reach, 3),
    "separation_in_noise": table[best[1]],
    "all_designs": table,
    "separates": [sorted(r.names) for r in rivals],
  }


def _readings(plant: JointModel, item: Scored, command: Array) -> Array:
  """Returns simulated readings under a design, surroundings at the joint's mean."""
  p, loads, table = compose(plant, item.terms, item.fit.x)
  around = plant.forces(loads, 0)
  weights, bounds = table if table is not None else (np.zeros((0, 0)), np.zeros(4))
  samples = np.arange(0.0, _DURATION - 0.02, 1.0 / _SAMPLES)
  count = int(_DURATION / plant.step) + 100
  fields = [np.full(count, mean) for mean in (*np.mean(around[:3], axis=1), 0.0)]
  out = np.zeros((4, len(samples)))
  kernel.simulate(  # type: ignore[call-arg]
    p,
    plant.step,
    np.arange(len(command)) / _RATE,
    command,
    samples,
    *fields,  # type: ignore
    np.zeros(count),
    plant.hinge,
    np.array([0]),
    command[:1].copy(),
    np.zeros(1),
    np.full(len(samples), np.nan),
    weights,
    bounds,
    out[0],
    out[1],
    out[2],
    out[3],
  )
  return out[0]
