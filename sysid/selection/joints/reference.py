"""The constants that reference logs show, and whether contacts bend before they slide there."""

import dataclasses

import numpy as np

from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants, sticking, tolerant
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.search.evidence import NAT, Scored
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.settings import Settings

_WEIGHTED = 4  # fits of the constants under weights of their priors, at most
_SETTLED = 0.1  # share by which these weights differ at the end
_FIRST = 6  # steps from a start of presliding


def reference_constants(before: JointLikelihood, settings: Settings) -> Scored:
  """Returns the constants that a reference shows, with a dry friction that holds at rest.

  An effect of friction holds, too: it must not be judged by the difference to one that creeps.
  Contacts that bend before they slide, which models leave out, are the machine's own where left-out
  logs are likelier with them: beside a friction that is rigid, effects of friction take their part.

  Args:
    before: logs of the reference; its scale is set by what is returned.
    settings: tolerances.
  """
  own = constants(before.plant, settings, healthy=True)
  holds = [sticking(before.plant)]
  first = Explainer(before, own, (), settings=settings, known=holds)
  rigid = _weighted(first, own, first.null)
  bends = candidates.presliding(before.plant)
  if bends is None:
    return rigid
  bends = plausible(bends, before.plant) if before.plant.hinge else bends
  known = [*holds, dataclasses.replace(bends, known=True)]
  second = Explainer(before, own, (), settings=settings, known=known)
  begun = [second.null]
  for start in bends.starts[1:]:
    begun.append(second.fitted(second.base, np.append(rigid.fit.x, start), _FIRST))
  best = second.adopt(max(begun, key=lambda item: item.evidence))
  bending = _weighted(second, own, best)
  rigid.nats = before.loglik(rigid.fit.held[0])
  if bending.evidence > rigid.evidence + NAT:
    return bending
  before.rescale(rigid.fit.residuals[0])
  rigid.nats = before.loglik(rigid.fit.held[0])
  return rigid


def _weighted(explainer: Explainer, own: Term, found: Scored) -> Scored:
  """Returns a baseline fitted on with constants some of which may be far off (`tolerant`)."""
  joint, settings, known = explainer.joint, explainer.settings, explainer.base[1:]
  for _ in range(_WEIGHTED):
    wider = tolerant(own, found.fit.values(found.terms[0]))
    if np.allclose(wider.prior, found.terms[0].prior, rtol=_SETTLED):
      break
    found = Explainer(joint, wider, (), settings=settings, known=known, start=found.fit.x).null
  return found
