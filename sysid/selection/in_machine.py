"""A joint's hypothesis as effects of the whole machine's model.

A joint is explained by itself: how large all of its torques are together no motion tells, and what
it carries it may have heavier than declared. In the machine a body has one mass for all that carry
it. So masses of chains are as declared there, and torques over what a joint has them off by: the
same motion.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.suite.effects import Effect, kind_of
from nerf2real.sysid.fit.layout import CONSTANTS
from nerf2real.sysid.hypotheses import free_force
from nerf2real.sysid.hypotheses.plausible import power_of_torque
from nerf2real.sysid.hypotheses.terms import FREE, WEAK, Term
from nerf2real.sysid.model.chains import carried, carrying
from nerf2real.sysid.model.simulation import Clocks
from nerf2real.sysid.selection.search.evidence import Scored

_TORQUES = ("damping", "armature", "friction", "gain", "limit")
"""Constants that are factors on torques."""


def effects_of(joint: str, item: Scored, *, offset: float = 0.0) -> tuple[list[Effect], Clocks]:
  """Returns the effects of a joint's hypothesis that are its own, and its latencies; its zero is
  shifted by an offset, rad, beside what the hypothesis says."""
  effects, clocks = [], Clocks()
  for term in item.terms:
    values = item.fit.values(term)
    x = np.array(list(values.values()))
    if term.kind == CONSTANTS:
      clocks = Clocks(values.get("skew", 0.0), values.get("latency", 0.0))
      offset += values.get("zero", 0.0)
      effects.append(dataclasses.replace(term.effect(x), target=joint))
    elif term.kind == FREE:
      effects.append(free_force.effect(term, x))
    elif not term.names:  # of a wider scope
      continue
    elif term.kind == "encoder_offset":
      offset += values["offset"]
    else:
      effects.append(term.effect(x))
  if offset:
    effects.append(Effect("encoder_offset", joint, {"offset": offset}))
  return [in_machine(effect, item) for effect in effects], clocks


def in_machine(effect: Effect, item: Scored) -> Effect:
  """Returns a joint's effect as the whole machine's model has it.

  Args:
    effect: of the joint.
    item: the joint's hypothesis.
  """
  return _over_masses(_beside_shared(effect, item.terms), _heavier(item))


def _heavier(item: Scored) -> float:
  """Returns the factor by which a hypothesis has what a joint carries heavier than declared; 1 for
  one body that nothing else carries, whose own mass it is."""
  model = item.joint.plant.model
  body = int(model.jnt_bodyid[model.joint(item.joint.plant.joint).id])
  if len(carried(model, body)) == len(carrying(model, body)) == 1:
    return 1.0
  constants = next((t for t in item.terms if t.kind == CONSTANTS), None)
  return 1.0 + (0.0 if constants is None else item.fit.values(constants).get("mass", 0.0))


def _over_masses(effect: Effect, heavier: float) -> Effect:
  """Returns an effect with its torques over a factor on masses, and these as declared."""
  if heavier == 1.0:
    return effect
  bounds = dict(effect.intervals)
  if effect.kind == "parameter_error":
    bounds.pop("mass", None)
    values: dict[str, Any] = {**dict.fromkeys(_TORQUES, 1.0), **effect.parameters, "mass": 1.0}
    scales = dict.fromkeys(_TORQUES, 1.0 / heavier)
  else:
    values = dict(effect.parameters)
    powers = {p.name: power_of_torque(p.unit) for p in kind_of(effect.kind).parameters}
    scales = {name: heavier**-power for name, power in powers.items() if power and name in values}
  for name, scale in scales.items():
    values[name] = (np.asarray(values[name]) * scale).tolist()
    if name in bounds:
      bounds[name] = bounds[name][0] * scale, bounds[name][1] * scale
  return dataclasses.replace(effect, parameters=values, intervals=bounds)


def _beside_shared(effect: Effect, terms: Sequence[Term]) -> Effect:
  """Returns a joint's strength times what the whole machine has beside it, as it is written down:
  of two effects of a kind the one that names the joint counts there."""
  factors = [dict(t.fixed)["gain"] for t in terms if t.wider and t.kind == WEAK == effect.kind]
  if not factors:
    return effect
  factor = float(np.prod(factors))
  gain = factor * float(effect.parameters["gain"])  # type: ignore[arg-type]
  bounds = dict(effect.intervals)
  if "gain" in bounds:
    bounds["gain"] = factor * bounds["gain"][0], factor * bounds["gain"][1]
  return dataclasses.replace(effect.replace(gain=gain), intervals=bounds)
