"""Contacts that bend before they slide: shown by a reference, and what they hide."""

import mujoco
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection import analysis
from nerf2real.sysid.selection.joints import subject
from nerf2real.sysid.selection.joints.reference import reference_constants
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import PENDULUM, log_of

ROUGH = PENDULUM.replace('frictionloss="0.03"', 'frictionloss="0.4"')
KINDS = ("stribeck_friction", "coulomb_friction", "viscous_friction", "backlash")


def bends(reach):
  return Effect("presliding", "joint", {"reach": reach})


def logs(effects, kinds=("sweep", "slow", "steps"), seed=0):
  return [log_of(ROUGH, kind, effects, duration=6.0, seed=seed + i) for i, kind in enumerate(kinds)]


@pytest.fixture(scope="module")
def model():
  found = mujoco.MjModel.from_xml_string(ROUGH)
  assert found.dof_frictionloss[0] == 0.4
  return found


@pytest.mark.parametrize("reach", [0.0, 0.006, 0.02])
def test_a_reference_shows_by_how_much_contacts_bend(model, reach):
  joint = JointLikelihood(JointModel(model, "joint", logs([bends(reach)])), settings=SETTINGS)
  usual = reference_constants(joint, SETTINGS)
  found = usual.values("presliding").get("reach", 0.0)
  assert found == pytest.approx(reach, rel=0.1, abs=3e-4)
  assert not usual.names, "it is the machine's own"
  assert abs(usual.fit.values(usual.terms[0])["friction"]) < 0.1


def test_friction_at_rest_has_its_name_beside_contacts_that_bend(model, monkeypatch):
  def few(plant, **_):
    return [plausible(t, plant) for t in candidates.library(plant) if t.kind in KINDS]

  monkeypatch.setattr(subject, "own_library", few)
  falls = Effect("stribeck_friction", "joint", {"breakaway": 0.25, "velocity": 0.15})
  found = analysis.analyse(model, logs([bends(0.01), falls], seed=3), logs([bends(0.01)]))
  assert [row["kind"] for row in found.effects] == ["stribeck_friction"]
  breakaway = found.effects[0]["parameters"]["breakaway"]
  assert breakaway["low"] < 0.25 < breakaway["high"]
  same = analysis.analyse(model, logs([bends(0.01)], seed=3), logs([bends(0.01)]))
  assert same.effects == []
  assert [row["kind"] for row in same.in_reference] == ["presliding"]
