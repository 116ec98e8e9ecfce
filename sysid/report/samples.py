"""Joint draws of the values of effects, from fits near the best and how sure each is."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.suite.effects import Effect
from nerf2real.suite.effects.registry import kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.selection.findings import Identified, Zero
from nerf2real.sysid.selection.in_machine import effects_of
from nerf2real.sysid.selection.joints.changes import Changed

COUNT = 64
"""Draws: chosen, enough for a standard deviation within 9 %."""

Rows = dict[tuple[str, str | None], dict[str, list[float]]]
"""Values of the draws by effect (kind, target) and parameter."""


def with_samples(
  found: Identified, effects: Sequence[Effect], random: np.random.Generator
) -> list[Effect]:
  """Returns effects with joint draws of those that joints have of their own.

  Fits near the best take turns, so that draws scatter among them as well. Effects of bodies and of
  the machine and those of sensors keep their intervals alone; a joint's zero that was found over
  all joints is drawn from its own.

  Args:
    found: the joints' fits.
    effects: of the extended model.
    random: what draws come from.
  """
  rows: Rows = {}
  targets = {effect.target for effect in effects}
  for item in (j for j in found.joints if j.joint in targets):
    rows |= _of_joint(item, found.zeros.get(item.joint, Zero()), random)
  return [_with(effect, rows.get((effect.kind, effect.target), {})) for effect in effects]


def _of_joint(item: Changed, zero: Zero, random: np.random.Generator) -> Rows:
  """Returns the draws of a joint's values; of effects that all fits near the best have."""
  near = item.near
  each = [
    intervals.draws(item.likelihood, scored.fit, -(-COUNT // len(near)), random) for scored in near
  ]
  offsets = zero.offset + zero.deviation * random.standard_normal(COUNT)
  rows: Rows = {}
  for at in range(COUNT):
    which, k = at % len(near), at // len(near)
    fit = dataclasses.replace(near[which].fit, x=each[which][k])
    scored = dataclasses.replace(near[which], fit=fit)
    effects, _ = effects_of(item.joint, scored, offset=float(offsets[at]))
    for effect in effects:
      values = rows.setdefault((effect.kind, effect.target), {})
      for name, value in effect.parameters.items():
        if isinstance(value, float):
          values.setdefault(name, []).append(value)
  return rows


def _with(effect: Effect, rows: dict[str, list[float]]) -> Effect:
  """Returns an effect with draws of the values that it has, within the kind's hard limits."""
  samples = {}
  for name, values in rows.items():
    if name in effect.parameters and len(values) == COUNT:
      limits = kind_of(effect.kind).parameter(name)
      samples[name] = [float(v) for v in np.clip(values, limits.minimum, limits.maximum)]
  return dataclasses.replace(effect, samples=samples)
