"""Whether a missed effect was lost by the search or by the evidence."""

from types import SimpleNamespace

import mujoco
import pytest

from benchmarks import missed_effects
from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import PENDULUM, log_of

_HIDDEN = (
  {"kind": "coulomb_friction", "torque": 0.3},
  {"kind": "motor_gain", "gain": 1.3, "scales_limit": 1.0},
)


@pytest.fixture(scope="module")
def explainer():
  effects = [
    Effect(str(h["kind"]), "joint", {k: v for k, v in h.items() if k != "kind"}) for h in _HIDDEN
  ]
  logs = [log_of(PENDULUM, kind, effects, duration=10.0) for kind in ("sweep", "slow", "steps")]
  plant = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs)
  kinds = {h["kind"] for h in _HIDDEN}
  library = [t for t in candidates.library(plant) if t.kind in kinds]
  return Explainer(JointLikelihood(plant, settings=SETTINGS), constants(plant), library)


def _row(explainer, monkeypatch, grown):
  monkeypatch.setattr(missed_effects, "grow", lambda explainer, leaves: grown)
  return missed_effects.row(SimpleNamespace(explainer=explainer, beyond=2.8), _HIDDEN)


def test_what_the_search_did_not_reach_is_told(explainer, monkeypatch):
  names, found, by, lost = _row(explainer, monkeypatch, [explainer.null])
  assert (names, found, lost) == ("coulomb_friction + motor_gain", "nothing", "the search")
  assert float(by) > 2.8


def test_what_was_found_is_not_lost(explainer, monkeypatch):
  hidden = missed_effects.from_values(explainer, _HIDDEN)
  assert hidden.values("motor_gain")["gain"] == pytest.approx(1.3, rel=0.05)
  *_, lost = _row(explainer, monkeypatch, [hidden])
  assert lost == "nothing"


def test_a_kind_that_no_library_has_is_not_fitted(explainer):
  assert missed_effects.from_values(explainer, [{"kind": "soft_stop"}]) is None


@pytest.mark.parametrize(
  ("effects", "joint"),
  [
    ([{"joint": "a"}, {"joint": "a"}], "a"),
    ([{"joint": "a"}, {"joint": "b"}], None),
    ([{"joint": "a"}, {"joint": None}], None),
    ([{"joint": "a", "in_library": False}], None),
    ([], None),
  ],
)
def test_sets_with_effects_at_one_joint_are_looked_at(effects, joint):
  assert missed_effects.one_joint({"effects": effects}) == joint
