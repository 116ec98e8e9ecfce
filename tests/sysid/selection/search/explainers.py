"""Explainers of a pendulum that has effects, and hypotheses of theirs."""

import mujoco
import numpy as np

from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import PENDULUM, log_of

KINDS = ("command_delay", "coulomb_friction", "motor_gain", "viscous_friction")


def explainer_of(hidden, kinds):
  """Returns one of a pendulum that has effects, and a library of some kinds."""
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  logs = [log_of(PENDULUM, kind, hidden, duration=5.0) for kind in ("sweep", "slow")]
  plant = JointModel(model, "joint", logs)
  library = candidates.library(plant)
  library.append(candidates.cogging(plant, signatures.waves(plant)))
  own = [t for t in library if t.kind in kinds]
  return Explainer(JointLikelihood(plant, settings=SETTINGS), constants(plant), own)


def fitted(explainer, *kinds):
  """Returns the hypothesis of some kinds, each in its first form from its first start."""
  terms = [next(t for t in explainer.library if t.kind == kind) for kind in kinds]
  chosen = (*explainer.base, *terms)
  x = np.concatenate([explainer.null.fit.x, *[t.starts[0] for t in terms]])
  return explainer.score(chosen, Fitter([explainer.joint], Layout([chosen])).fit(x, iterations=6))
