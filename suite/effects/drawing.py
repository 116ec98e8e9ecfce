"""Effects drawn from what is known of their values, for domain randomisation over what is open."""

from collections.abc import Iterable

import numpy as np

from nerf2real.suite.effects.effect import Effect, Value
from nerf2real.suite.effects.files import count_samples
from nerf2real.suite.effects.registry import kind_of


def draw_effects(
  effects: Iterable[Effect], rng: np.random.Generator | np.random.RandomState
) -> list[Effect]:
  """Returns effects whose scalar values are drawn.

  Values with samples are taken from one joint draw, the same of all effects, so that what goes
  together stays together; others are drawn uniformly from their intervals, where they have one.
  Draws stay within the kind's hard limits. Domain randomisation as of Tobin et al. 2017
  (https://arxiv.org/abs/1703.06907), over what an identification left open.
  """
  effects = list(effects)
  count = count_samples(effects)
  at = min(int(rng.uniform(0, count)), count - 1) if count else 0
  drawn = []
  for effect in effects:
    kind = kind_of(effect.kind)
    values: dict[str, Value] = {name: row[at] for name, row in effect.samples.items()}
    for name, (low, high) in effect.intervals.items():
      parameter = kind.parameter(name)
      if name in values or name not in effect.parameters or parameter.is_list:
        continue
      if np.isfinite([low, high]).all():
        value = float(rng.uniform(min(low, high), max(low, high)))
        values[name] = min(max(value, parameter.minimum), parameter.maximum)
    drawn.append(effect.replace(**values))
  return drawn


def as_gravity(effect: Effect) -> Effect:
  """Returns a floor's slope as a tilt of gravity; other effects as they are.

  A scene's floor is z = 0 and its furniture stands on it: where the floor slopes, all of the room
  leans with it, which in the room's frame is gravity turned the other way.
  """
  if effect.kind != "floor_slope":
    return effect
  parameters = {name: -float(value) for name, value in effect.parameters.items()}  # type: ignore
  intervals = {name: (-high, -low) for name, (low, high) in effect.intervals.items()}
  samples = {name: [-value for value in row] for name, row in effect.samples.items()}
  return Effect("gravity_tilt", None, parameters, intervals, samples)
