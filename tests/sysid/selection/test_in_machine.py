"""Joints' hypotheses as effects of the whole machine's model."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.selection.in_machine import effects_of
from tests.sysid.selection.wider.test_zeros import CHAIN
from tests.sysid.synthetic import PENDULUM, log_of

SPRING, HOT = {"stiffness": 0.5, "reference": 0.1}, {"heating": 0.6, "time_constant": 30.0}


@pytest.fixture(scope="module")
def model():
  return mujoco.MjModel.from_xml_string(CHAIN)


def _hypothesis(model, joint, factor, xml=CHAIN):
  """Returns a hypothesis of a joint with all that it carries, and all its torques, larger."""
  plant = JointModel(model, joint, [log_of(xml, "sweep", duration=1.0)])
  own = constants(plant)
  spring, hot = (
    next(t for t in candidates.library(plant) if t.kind == kind)
    for kind in ("spring", "thermal_derating")
  )
  values = {
    own: {
      n: factor - 1.0 if n in ("damping", "armature", "friction", "gain", "mass") else 0.0
      for n in own.names
    },
    spring: SPRING | {"stiffness": factor * SPRING["stiffness"]},
    hot: HOT | {"heating": HOT["heating"] / factor**2},
  }
  fit = SimpleNamespace(values=lambda term: values[term])
  joint_of = SimpleNamespace(plant=plant)
  return SimpleNamespace(joint=joint_of, terms=(own, spring, hot), fit=fit)


@pytest.mark.parametrize("joint", ["shoulder", "elbow"])
def test_in_a_chain_masses_are_as_declared_and_torques_over_them(model, joint):
  """What one joint has heavier, others carry, too."""
  (own, spring, hot), _ = effects_of(joint, _hypothesis(model, joint, 0.85))
  limit = 1.0 / 0.85  # as declared, of torques that are larger
  expected = dict.fromkeys(own.parameters, 1.0) | {"limit": limit}
  assert own.parameters == pytest.approx(expected)
  assert spring.parameters == pytest.approx(SPRING)
  assert {n: hot.parameters[n] for n in HOT} == pytest.approx(HOT)


def test_a_body_that_one_joint_alone_carries_has_its_own_mass():
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  (own, spring, _), _ = effects_of("joint", _hypothesis(model, "joint", 0.85, PENDULUM))
  assert {own.parameters[n] for n in ("mass", "gain")} == {0.85}
  assert spring.parameters["stiffness"] == pytest.approx(0.85 * SPRING["stiffness"])


def test_the_whole_machine_moves_as_the_joint_did_by_itself(model):
  """Gains a quarter larger, said as all else a fifth smaller."""
  strong = [Effect("parameter_error", "shoulder", {"gain": 1.25, "limit": 1.25})]
  log = log_of(CHAIN, "sweep", strong, duration=3.0, rounding=1e-9)
  item = _hypothesis(model, "shoulder", 0.8)
  own = item.terms[0]
  values = item.fit.values(own)
  values["gain"] = 0.0
  alone = SimpleNamespace(joint=item.joint, terms=(own,), fit=item.fit)
  found, _ = effects_of("shoulder", alone)
  left = simulation.error(model, [log], found)
  assert left < 0.02 * simulation.error(model, [log])
  told = dataclasses.replace(own.effect(np.array(list(values.values()))), target="shoulder")
  assert simulation.error(model, [log], [told]) > 10.0 * left
