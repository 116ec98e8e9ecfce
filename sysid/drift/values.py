"""Fits the named values of a stored result anew to later logs and compares them with its intervals.

Only what is named moves, and each joint's constants within what two recordings of one machine
differ by; all else of the hypothesis is held. Two values differ where

    |new - stored| > z sqrt(h_stored^2 + h_new^2) / 1.96

h the half widths of their 95 % intervals that face each other, z at the family-wise level. A value
whose effect changes the later logs by less than their noise is not shown by them, and not judged.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from scipy.stats import norm

from nerf2real.suite.effects import Effect, kind_of
from nerf2real.sysid.design.information import Place, of_logs
from nerf2real.sysid.drift.stored import Stored, StoredJoint
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.layout import CONSTANTS, Fit, Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.candidates import library
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.hypotheses.terms import FREE, Term
from nerf2real.sysid.selection.wider import zeros
from nerf2real.sysid.selection.wider.wide import ZERO
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray

_SHARES = (0.0, 0.5, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0)
"""Of the stored size, where fits begin: chosen, from an effect that has gone to a threefold one."""
_HELD = 1e-6  # of a value's scale: the prior of one that is held
_ROUNDS, _ITERATIONS = 4, 6  # of fitting and setting the residual's scale in turn


@dataclasses.dataclass(frozen=True)
class Value:
  """A value of a named effect, then and now."""

  kind: str
  where: str
  name: str
  unit: str
  stored: tuple[float, float, float]
  """Value, low and high."""
  later: tuple[float, float, float] | None
  """None where the later logs do not show it."""
  apart: float
  """Standard errors between them."""
  state: str
  """fits, moved or not shown."""


@dataclasses.dataclass(frozen=True)
class _Refit:
  """A named effect, fitted anew."""

  row: dict[str, Any]
  where: str
  effect: Effect | None
  """None where the logs do not show it."""


def compare(
  stored: Stored, now: Mapping[str, JointLikelihood], *, level: float, settings: Settings
) -> tuple[tuple[Value, ...], tuple[str, ...]]:
  """Returns every named value then and now, and the effects that cannot be compared.

  Args:
    stored: what was identified.
    now: the later logs of every joint.
    level: of significance, of all values together.
    settings: what two recordings of one machine differ by.
  """
  found, skipped = [], []
  for row in stored.content["effects"]:
    refit = _refit(row, stored, now, settings)
    if refit is None:
      skipped.append(row["kind"])
    else:
      found.append(refit)
  pairs = [
    (refit, name, then)
    for refit in found
    for name, then in refit.row["parameters"].items()
    if then["low"] is not None and then["value"] is not None and then["high"] is not None
  ]
  beyond = float(norm.isf(level / 2.0 / max(len(pairs), 1)))
  return tuple(_value(refit, name, then, beyond) for refit, name, then in pairs), tuple(skipped)


def _value(refit: _Refit, name: str, then: dict[str, Any], beyond: float) -> Value:
  before = (then["value"], then["low"], then["high"])
  words = (refit.row["kind"], refit.where, name, then["unit"], before)
  if refit.effect is None or name not in refit.effect.intervals:
    return Value(*words, None, 0.0, "not shown")
  value = float(refit.effect.parameters[name])  # type: ignore[arg-type]
  low, high = refit.effect.intervals[name]
  move = value - before[0]
  widths = (
    (before[2] - before[0], value - low) if move > 0 else (before[0] - before[1], high - value)
  )
  apart = SETTINGS.sigmas * abs(move) / max(float(np.hypot(*widths)), 1e-300) if move else 0.0
  return Value(*words, (value, low, high), apart, "moved" if apart > beyond else "fits")


def _refit(
  row: dict[str, Any],
  stored: Stored,
  now: Mapping[str, JointLikelihood],
  settings: Settings,
) -> _Refit | None:
  """Returns an entry of the report fitted anew; None if it is of no joint's hypothesis."""
  members = row.get("evidence", {}).get("joints")
  if "servo_law" in row.get("evidence", {}):  # by the duty alone
    law = now[row["joint"]].law
    if law is None:
      return _Refit(row, row["joint"], None)
    gain = {"gain": law.gain}, {"gain": law.interval}
    return _Refit(row, row["joint"], Effect(row["kind"], row["joint"], *gain))
  if row["kind"] == "parameter_error" and members:  # medians over joints
    return None
  if members:
    together = [j for j in stored.joints if j.joint in members]
    if row["kind"] == ZERO:
      as_tilt = _zero_of_tilt(row, stored.model, together, now, settings)
      return as_tilt or _shared(row, together, now, settings)
    return _shared(row, together, now, settings)
  mine = next(
    (j for j in stored.joints if row["joint"] in (None, j.joint) and _named(j, row["kind"])), None
  )
  return None if mine is None else _own(row, mine, now[mine.joint], settings)


def _named(item: StoredJoint, kind: str) -> Term | None:
  """Returns the term of a hypothesis that an entry of the report names."""
  kind = CONSTANTS if kind == "parameter_error" else kind
  return next((t for t in item.terms if t.kind == kind and t.names and not t.known), None)


def _own(
  row: dict[str, Any], item: StoredJoint, joint: JointLikelihood, settings: Settings
) -> _Refit:
  """Returns an effect of one joint fitted anew."""
  named = _named(item, row["kind"])
  assert named is not None
  terms, x = _held(item, settings, free=named)
  term = terms[item.terms.index(named)]
  values = item.split[item.terms.index(named)]
  where = row["joint"] or "all"
  constants = terms[0]
  if named.kind != CONSTANTS and not _shows(joint, constants, term, values):
    return _Refit(row, where, None)
  layout = Layout([terms])
  fit = _fitted([joint], layout, x, layout.spans[layout.terms.index(term)], term)
  bounds = intervals.intervals(joint, fit, term, own_latency=False)
  return _Refit(row, where, term.effect(np.array(list(fit.values(term).values())), bounds))


def _shared(
  row: dict[str, Any],
  members: Sequence[StoredJoint],
  now: Mapping[str, JointLikelihood],
  settings: Settings,
) -> _Refit | None:
  """Returns an effect of several joints fitted anew to all of them."""
  joints = [now[m.joint] for m in members]
  held = next(
    (t for t in members[0].terms if t.kind == row["kind"] and t.known and not t.names), None
  )
  if held is None:
    return None
  known = dict(held.fixed)
  own_terms = [_held(m, settings, without=held) for m in members]
  term = next(
    (
      dataclasses.replace(t if not j.plant.hinge else plausible(t, j.plant), target=held.target)
      for j in joints
      for t in library(j.plant)
      if t.kind == held.kind
      and (held.kind != "payload" or t.target == held.target)
      and all(known.get(n) == v for n, v in t.fixed)
    ),
    None,
  )
  if term is None:
    return None
  values = np.array([known[name] for name in term.names])
  where = str(row.get("body") or row["joint"] or "all")
  shown = [
    _shows(j, terms[0], term, values) for j, (terms, _) in zip(joints, own_terms, strict=True)
  ]
  if not any(shown):
    return _Refit(row, where, None)
  layout = Layout([terms for terms, _ in own_terms], [term])
  x = np.concatenate([values, *[own for _, own in own_terms]])
  fit = _fitted(joints, layout, x, layout.spans[0], term)
  reaches = intervals.reaches(fit, intervals.spread(fit, joints), layout.spans[0])
  bounds = intervals.around(term, fit.x[: len(values)], *reaches)
  return _Refit(row, where, term.effect(fit.x[: len(values)], bounds))


def _zero_of_tilt(
  row: dict[str, Any],
  model: mujoco.MjModel,
  members: Sequence[StoredJoint],
  now: Mapping[str, JointLikelihood],
  settings: Settings,
) -> _Refit | None:
  """Returns a joint's zero that a tilt of the machine was told as, fitted anew as that tilt; None
  where it was none."""
  refit = _shared(row | {"kind": zeros.TILT}, members, now, settings)
  if refit is None:
    return None
  effect = refit.effect
  if effect is not None:
    x = np.array([effect.parameters[name] for name in ("x", "y")], float)
    offset, interval = zeros.part_of_tilt(model, x, effect.intervals)
    effect = Effect(row["kind"], row["joint"], {"offset": offset}, {"offset": interval})
  return _Refit(row, row["joint"], effect)


def _held(
  item: StoredJoint, settings: Settings, *, free: Term | None = None, without: Term | None = None
) -> tuple[list[Term], Array]:
  """Returns a hypothesis of which one term and the constants move, and its values [n]."""
  repeat = dict(settings.repeat)
  terms, parts = [], []
  for term, values in zip(item.terms, item.split, strict=True):
    if term == without:
      continue
    part = values
    if term is free:
      moving = term
    elif term.kind == CONSTANTS:
      sigma = tuple(repeat[name] for name in term.names)
      moving = dataclasses.replace(term, prior=sigma, centre=tuple(values))
    elif term.kind == FREE:  # its table is made of its values
      sigma = tuple(_HELD * scale for scale in term.scale)
      moving = dataclasses.replace(term, prior=sigma, centre=tuple(values))
    else:
      moving, part = term.held_at(values), values[:0]
    terms.append(moving)
    parts.append(part)
  return terms, np.concatenate([np.zeros(0), *parts])


def _shows(joint: JointLikelihood, constants: Term, term: Term, values: Array) -> bool:
  """Tells whether an effect changes the readings by their noise, beyond what constants imitate."""
  place = Place(term, tuple(map(float, values)))
  return bool(of_logs(joint, constants, [place])[0, 0] >= 1.0)


def _fitted(
  joints: Sequence[JointLikelihood], layout: Layout, x: Array, span: tuple[int, int], term: Term
) -> Fit:
  """Returns a fit from the best of several sizes of an effect, the scale set as it improves."""
  _rescale(joints, layout, x)
  fitter = Fitter(joints, layout)
  tried = np.repeat(x[None], len(_SHARES), axis=0)
  tried[:, span[0] : span[1]] = [_sized(term, x[span[0] : span[1]], share) for share in _SHARES]
  tried = np.clip(tried, layout.low, layout.high)
  fit = fitter.fit(tried[int(np.argmin(fitter.costs(tried)))], iterations=_ITERATIONS)
  for _ in range(_ROUNDS):
    _rescale(joints, layout, fit.x)
    before = float(fitter.costs(fit.x[None])[0])
    fit = fitter.fit(fit.x, iterations=_ITERATIONS)
    if fit.cost > before - joints[0].settings.settled:
      break
  return fit


def _sized(term: Term, values: Array, share: float) -> Array:
  """Returns values of which the sizes are a share as far from rest; a threshold is multiplied."""
  result = values.copy()
  for at, name in enumerate(term.names):
    if term.kind == CONSTANTS:
      result[at] *= share
      continue
    parameter = kind_of(term.kind).parameter(name)
    if not parameter.shape:
      rest = parameter.nominal if np.isfinite(parameter.nominal) else 0.0
      result[at] = rest + share * (values[at] - rest)
  return result


def _rescale(joints: Sequence[JointLikelihood], layout: Layout, x: Array) -> None:
  for joint, terms, index in zip(joints, layout.of_joint, layout.index, strict=True):
    joint.rescale(joint.residuals(terms, x[index][None])[0])
