"""Loads that one joint shows, as the joints that carry it feel them.

A joint is judged by itself, and a load near its axis is little more there than an inertia. All that
carry it feel its weight: what it gains at the one must not be lost at the others.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.stats import norm

from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.chains import ancestors
from nerf2real.sysid.selection.joints import changes
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.search.evidence import Scored
from nerf2real.sysid.selection.search.explain import scored_on
from nerf2real.sysid.selection.wider.wide import Evidence, Row
from nerf2real.sysid.settings import Settings

LOAD = "payload"


def borne(model: mujoco.MjModel, changed: Sequence[Changed], settings: Settings) -> list[Changed]:
  """Returns joints explained anew without a load that those which carry it are clearly worse with.

  No log may be clearly worse with an effect (`naming.carries_over`), nor may such a joint.

  Args:
    model: the declared one.
    changed: the joints' explanations.
    settings: tolerances and effort.
  """
  result, least = list(changed), float(norm.isf(settings.level))
  for at, item in enumerate(changed):
    likely = max((s for s in item.ranked if not s.neutral), key=lambda s: s.evidence)
    tried = {id(s): s for s in (likely, item.found.best, item.extended)}.values()
    loads = [load for s in tried if (load := _load_of(s)) is not None]
    if not loads:
      continue
    way = ancestors(model, str(loads[0].target))
    carriers = [c for c in result if c.joint in way and c.joint != item.joint]
    if not carriers or all(_felt(load, carriers).clear > -least for load in loads):
      continue
    explainer = item.subject.explainer
    explainer.library = [t for t in explainer.library if t.kind != LOAD]
    explainer.scored = {k: s for k, s in explainer.scored.items() if LOAD not in s.names}
    if LOAD in item.found.best.names or item.likelihood.follows:
      result[at] = changes.explain(item.subject, settings)
    else:
      result[at] = changes.judged(item.subject, explainer.ranked(), settings)
  return result


def _load_of(item: Scored) -> Term | None:
  """Returns the load of a joint's own among a hypothesis' effects, with the values it has there."""
  load = next((t for t in item.terms if t.name == LOAD and not t.wider), None)
  if load is None:
    return None
  values = np.array(list(item.fit.values(load).values()))
  return dataclasses.replace(load.held_at(values), known=True)


def _felt(load: Term, carriers: Sequence[Changed]) -> Evidence:
  """Returns the evidence of a load at joints that carry it, beside what they have of their own."""
  rows, prior = {}, 0.0
  for carrier in carriers:
    bare = carrier.found.best
    beside = scored_on(carrier.likelihood, (*bare.terms, load), bare.fit.x, iterations=4)
    rows[carrier.joint] = Row.of(beside, bare)
    prior += beside.prior - bare.prior
  return Evidence(rows, prior)
