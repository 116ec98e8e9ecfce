"""An effect that is the same throughout a log, one that grows, and one that is seen too little."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit import constancy
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection.search.explain import Explainer
from tests.sysid.synthetic import PENDULUM, log_of


def _log(kind: str, seed: int, first: float, last: float):
  """Returns a log whose viscous friction goes from one coefficient to another, nearly: positions
  go from the ones that the one makes to those of the other."""
  logs = [
    log_of(PENDULUM, kind, [Effect("viscous_friction", "joint", {"coefficient": c})], seed=seed)
    for c in (first, last)
  ]
  one, other = (log.states.position for log in logs)
  share = np.linspace(0.0, 1.0, len(one))[:, None]
  states = dataclasses.replace(logs[0].states, position=(1.0 - share) * one + share * other)
  return dataclasses.replace(logs[0], states=states)


def _fitted(first: float, last: float):
  logs = [_log(kind, seed, first, last) for seed, kind in enumerate(("sweep", "slow", "steps"))]
  joint = JointLikelihood(JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs))
  (term,) = [t for t in candidates.library(joint.plant) if t.kind == "viscous_friction"]
  explainer = Explainer(joint, constants(joint.plant), [term])
  return joint, explainer.adopt(explainer.extend(explainer.null, 1)[0]).fit, term


@pytest.mark.parametrize(("first", "last"), [(0.5, 0.5), (0.3, 0.7), (0.8, 0.2)])
def test_a_share_that_an_effect_grows_by_is_found(first: float, last: float) -> None:
  joint, fit, term = _fitted(first, last)
  share, error = constancy.growth([joint], fit, term)
  assert share == pytest.approx((last - first) / (last + first), abs=0.1)
  assert error < 0.05
  assert constancy.is_constant([joint], fit, term, 2.8) == (first == last)
  assert constancy.is_constant([joint], fit, term, 1e3)  # as if it were hardly seen


def test_what_goes_with_time_by_its_law_and_freed_constants_are_not_asked() -> None:
  joint, fit, term = _fitted(0.8, 0.2)
  for other in (dataclasses.replace(term, freed=True), dataclasses.replace(term, names=())):
    assert constancy.is_constant([joint], fit, other, 2.8)
  assert constancy.is_constant([joint], fit, dataclasses.replace(term, kind="supply_sag"), 2.8)
