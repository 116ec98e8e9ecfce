"""Which effects of a finding enter the simulation: what is named, with what is fitted beside it.

The analyser's extended model holds more than it claims: small effects of joints whose names are not
certain, and forces of any form that explain what no name does. In the air they make errors smaller;
under weight, where a robot walks, nothing has judged them, and they cost time at every step. They
stay out, but for the learned forces where the verdict is that no name explains the motion. At a
joint with a name all but the learned force enters: a weak motor's value is that beside its gear's
friction, and without the friction that joint is weaker under weight than was measured.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from nerf2real.suite.effects import Effect

CONSTANTS = ("parameter_error",)  # errors of declared constants: no effect, and no name
LEARNED = "residual_force"  # a force without a name
UNEXPLAINED = "unexplained"
# Why an effect enters, in words.
CLAIMED, OWN = "named", "the robot had it before"
FITTED_BESIDE, FORCED = "fitted beside a name", "no name explains that joint"

Rows = Sequence[Mapping[str, Any]]
"""Entries of the analyser's report."""


def reasons(effects: Sequence[Effect], content: Mapping[str, Any]) -> list[str]:
  """Returns why the simulation gets an effect, for each of them; "" where it does not.

  It gets what the report claims, what it finds in the reference, too (the robot has it), and what
  was fitted beside a claim at its joint, but for learned forces. Where the verdict is `unexplained`
  the joints with a learned force have all that was fitted beside it.

  Args:
    effects: Of the extended model.
    content: Of the report; one without entries names all effects.
  """
  if "effects" not in content:
    return [CLAIMED] * len(effects)
  claimed: Rows = content["effects"]
  joints = {row["joint"] for row in claimed if row.get("joint")}
  alike = any(row["kind"] in CONSTANTS and not row.get("joint") for row in claimed)  # all joints'
  forced = {e.target for e in forces(effects, content)}

  def reason(effect: Effect) -> str:
    if is_listed(effect, claimed):
      return CLAIMED
    if is_listed(effect, content.get("in_reference", ())):
      return OWN
    if effect.target in forced:
      return FORCED
    beside = effect.target in joints and effect.kind != LEARNED
    return FITTED_BESIDE if beside or (alike and effect.kind in CONSTANTS) else ""

  return [reason(effect) for effect in effects]


def entering(effects: Sequence[Effect], content: Mapping[str, Any]) -> list[Effect]:
  """Returns the effects that the simulation gets, with their intervals and samples; `reasons`."""
  told = reasons(effects, content)
  return [effect for effect, reason in zip(effects, told, strict=True) if reason]


def forces(effects: Sequence[Effect], content: Mapping[str, Any]) -> list[Effect]:
  """Returns the learned forces that stand in for names; none where names explain the motion."""
  if content["verdict"] != UNEXPLAINED:
    return []
  return [effect for effect in effects if effect.kind == LEARNED]


def is_listed(effect: Effect, rows: Rows) -> bool:
  """Returns whether an effect has an entry in a report: kind, place and values."""

  def is_of(row: Mapping[str, Any]) -> bool:
    place = row.get("body") or row.get("geom") or row.get("joint")
    values = {name: found["value"] for name, found in row.get("parameters", {}).items()}
    same = all(effect.parameters.get(name, value) == value for name, value in values.items())
    return (row["kind"], place) == (effect.kind, effect.target) and same

  return any(is_of(row) for row in rows)
