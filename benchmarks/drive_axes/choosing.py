"""Which kinds of effect a set has, for generators whose kinds say plants and group."""

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeVar

import numpy as np


class Choice(Protocol):
  """A kind that can be chosen."""

  @property
  def group(self) -> str:
    """Kinds of one group are never drawn together."""

  @property
  def plants(self) -> tuple[str, ...]:
    """Machines that may have it."""


K = TypeVar("K", bound=Choice)


def choose(
  mix: str,
  library: Mapping[str, K],
  outside: Mapping[str, K],
  random: np.random.Generator,
  *,
  known: Sequence[str],
  among: Sequence[str] | None = None,
  kinds: Sequence[str] | None = None,
) -> tuple[dict[str, K], list[str]]:
  """Returns the kinds of a set's effects, by name, and the plants that may have them.

  Args:
    mix: `single`, `pair`, `outside` or `healthy`.
    library: kinds that the library names.
    outside: kinds that it does not.
    random: generator.
    known: all plants.
    among: plants to draw from; None for all.
    kinds: to draw from; None for all.

  Raises:
    ValueError: a plant or kind that is not there, or none that fits the mix.
  """
  where = list(among or known)
  unknown = set(where) - set(known) | set(kinds or ()) - {*library, *outside}
  if unknown:
    every = f"plants of {tuple(known)} and kinds of {[*library, *outside]}"
    raise ValueError(f"Found {sorted(unknown)}, expected {every}.")
  source = outside if mix == "outside" else library
  chosen: dict[str, K] = {}
  for _ in range({"healthy": 0, "pair": 2}.get(mix, 1)):
    groups = {kind.group for kind in chosen.values()}
    left = [
      name
      for name, kind in source.items()
      if (not kinds or name in kinds) and kind.group not in groups and set(kind.plants) & set(where)
    ]
    if not left:
      raise ValueError(f"Found no kinds for the mix {mix!r} among {kinds} on {where}; name others.")
    name = str(random.choice(left))
    chosen[name] = source[name]
    where = [plant for plant in where if plant in source[name].plants]
  return chosen, where
