"""From the terms of a hypothesis to the kernel's parameters and loads of one joint."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.suite.effects.registry import KINDS
from nerf2real.sysid.hypotheses import force_law, free_force
from nerf2real.sysid.hypotheses.terms import FREE, Term
from nerf2real.sysid.model.joint import JointModel, Load, Table

Array = np.ndarray


class Composed(NamedTuple):
  """A hypothesis with its values, as the kernel takes it."""

  p: Array
  """Kernel parameters [P]."""
  loads: list[Load]
  """What changes of masses and gravity."""
  table: Table | None
  """A free force."""


def compose(plant: JointModel, terms: Sequence[Term], x: Array) -> Composed:
  """Returns terms with values x [n] composed, applied in the order of the suite's effects."""
  p, loads, table, forces = plant.declared.copy(), [], None, []
  ends = np.cumsum([len(term.names) for term in terms])
  for index in _order(tuple(term.kind for term in terms)):
    term = terms[index]
    part = x[ends[index] - len(term.names) : ends[index]]
    values = dict(zip(term.names, map(float, part), strict=True)) | dict(term.fixed)
    if term.kind == "encoder_offset" and plant.among_others:
      loads.append(plant.zero_load(str(term.target), values["offset"]))
    if term.kind != "encoder_offset" or term.target == plant.joint:
      term.apply(plant, p, part)
    if term.kind in KINDS and KINDS[term.kind].law is not None:
      forces.append((term, values))
    elif term.kind == "payload":
      m, a, b, c = (values[n] for n in ("mass", "x", "y", "z"))
      moments = m * np.array([1, a, b, c, a * a, b * b, c * c, a * b, a * c, b * c])
      loads.append(Load(str(term.target), moments))
    elif term.kind == "gravity_tilt":
      loads.append(plant.tilt_load(values["x"], values["y"]))
    elif term.kind == "calibration" and "mass" in values:
      loads.append(Load("mass", np.array([values["mass"]])))
    elif term.kind == FREE:
      table = free_force.table(term, part)
  for term, values in forces:  # over the places of a free force, where there is one
    table = force_law.add(plant, term, values, table)
  return Composed(p, loads, table)


@functools.cache
def _order(kinds: tuple[str, ...]) -> tuple[int, ...]:
  """Returns which term is applied when: constants first, then kinds as the suite has them."""
  places = {kind: place for place, kind in enumerate(KINDS)}
  return tuple(sorted(range(len(kinds)), key=lambda index: places.get(kinds[index], -1)))
