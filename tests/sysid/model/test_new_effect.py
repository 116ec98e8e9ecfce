"""An effect that is one file, this one: simulated, tabulated, searched for and found."""

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.suite.effects.effect import Parameter
from nerf2real.suite.effects.kinds import laws
from nerf2real.suite.effects.kinds.force_law import force_kind
from nerf2real.suite.effects.registry import KINDS
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses import candidates, free_force
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import table_force
from tests.sysid.synthetic import PENDULUM, log_of


@laws.law
def cushion(position: float, velocity: float, stiffness: float, place: float) -> float:
  """Returns the torque of a spring that begins softly at a place."""
  beyond = max(position - place, 0.0)
  return -stiffness * beyond * beyond


KIND = force_kind(
  "cushion",
  "a spring that begins at a place",
  cushion,
  (
    Parameter("stiffness", "N m/rad", 0.0, 0.0, 20.0, "torque per squared way", minimum=0.0),
    Parameter("place", "rad", 0.0, 0.0, 1.0, "where it begins", shape=True),
  ),
)
THERE = Effect("cushion", "joint", {"stiffness": 8.0, "place": 0.3})


@pytest.fixture(autouse=True)
def registered(monkeypatch):
  monkeypatch.setitem(KINDS, "cushion", KIND)


def plant_of(effects=()):
  logs = [
    log_of(PENDULUM, k, effects, duration=5.0, seed=i) for i, k in enumerate(("sweep", "slow"))
  ]
  return JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs)


def test_the_suite_adds_its_force():
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  data = mujoco.MjData(model)
  stack = EffectStack([THERE]).bind(model)
  stack.reset()
  data.qpos[0] = 0.8
  stack.before_step(data, np.zeros(1))
  assert data.qfrc_applied[0] == pytest.approx(-8.0 * 0.5**2)
  data.qpos[0] = 0.2
  stack.before_step(data, np.zeros(1))
  assert data.qfrc_applied[0] == 0.0


def test_the_kernel_simulates_it_as_mujoco_does():
  plant = plant_of([THERE])
  term = next(t for t in candidates.library(plant) if t.kind == "cushion")
  c = compose(plant, (term,), np.array([8.0, 0.3]))
  for index, log in enumerate(plant.logs):
    made = plant.run(c.p, c.loads, index, table=c.table).position
    assert np.sqrt(np.mean((made - log.position) ** 2)) < 6e-4  # the encoder's rounding is 4.4e-4
  bare = compose(plant, (), np.zeros(0))
  made = plant.run(bare.p, bare.loads, 0, table=bare.table).position
  assert np.sqrt(np.mean((made - plant.logs[0].position) ** 2)) > 5e-3


def test_it_adds_to_a_force_of_any_form():
  plant = plant_of()
  term = next(t for t in candidates.library(plant) if t.kind == "cushion")
  free = free_force.free_force(plant)
  x = np.random.default_rng(0).normal(size=len(free.names)) * 0.1
  alone, both = (
    compose(plant, terms, values).table
    for terms, values in (((free,), x), ((free, term), np.append(x, [8.0, 0.3])))
  )
  q, v = np.linspace(-0.5, 0.6, 30), np.linspace(-1.0, 1.0, 30)
  added = table_force(q, v, *both) - table_force(q, v, *alone)
  np.testing.assert_allclose(added, -8.0 * np.maximum(q - 0.3, 0.0) ** 2, atol=2e-3)


def test_the_analyser_finds_its_values():
  plant = plant_of([THERE])
  joint, own = JointLikelihood(plant), constants(plant)
  term = next(t for t in candidates.library(plant) if t.kind == "cushion")
  fitter = Fitter([joint], Layout([(own, term)]))
  start = np.concatenate([own.starts[0], term.starts[0]])
  joint.rescale(joint.residuals((), np.zeros((1, 0)))[0])
  for _ in range(4):
    fit = fitter.fit(start, iterations=4)
    joint.rescale(fit.residuals[0])
    start = fit.x
  assert fit.values(term)["stiffness"] == pytest.approx(8.0, rel=0.1)
  assert fit.values(term)["place"] == pytest.approx(0.3, abs=0.02)
  assert fit.values(term).keys() == {"stiffness", "place"}
