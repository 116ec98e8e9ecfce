"""Effects drawn from the intervals of their values, for domain randomisation over what is known."""

from collections.abc import Iterable

import numpy as np

from nerf2real.suite.effects.effect import Effect, Value
from nerf2real.suite.effects.registry import kind_of


def draw_effects(
  effects: Iterable[Effect], rng: np.random.Generator | np.random.RandomState
) -> list[Effect]:
  """Returns effects whose scalar values are drawn, each uniformly from its interval.

  Values without an interval stay; draws stay within the kind's hard limits. Domain randomisation as
  of Tobin et al. 2017 (https://arxiv.org/abs/1703.06907), over what an identification left open.
  """
  drawn = []
  for effect in effects:
    kind = kind_of(effect.kind)
    values: dict[str, Value] = {}
    for name, (low, high) in effect.intervals.items():
      parameter = kind.parameter(name)
      if name in effect.parameters and not parameter.is_list and np.isfinite([low, high]).all():
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
  return Effect("gravity_tilt", None, parameters, intervals)
