"""Fits near the best with a richer friction."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.simulation import Member
from nerf2real.sysid.selection.in_machine import effects_of
from nerf2real.sysid.selection.joints.baseline import widened
from nerf2real.sysid.selection.search.elaboration import _DRAWS, bases, elaborated
from nerf2real.sysid.selection.search.evidence import kinds_of
from nerf2real.sysid.selection.search.explain import Explainer
from tests.sysid.fit.test_likelihood import joint_of
from tests.sysid.synthetic import PENDULUM, log_of

RICH = Effect(
  "load_friction",
  "joint",
  {"coefficient": 0.05, "quadratic": 0.3, "rest": 0.5, "velocity": 0.2, "carried": 2.0},
)


@pytest.fixture(scope="module")
def explainer():
  _, joint = joint_of(("sweep", "slow", "steps"), [RICH])
  own = constants(joint.plant)
  return Explainer(joint, own, (), freed=widened(own))


@pytest.fixture(scope="module")
def near(explainer):
  return elaborated(explainer, explainer.null, explainer.null, ()), explainer.joint


def test_every_fit_has_what_is_named(explainer):
  freed = (explainer.freed, *explainer.null.terms[1:])
  best = explainer.score(freed, dataclasses.replace(explainer.null.fit, layout=Layout([freed])))
  both, one = (bases(explainer, best, named) for named in ((), ("parameter_error",)))
  assert [kinds_of(terms) for terms, _ in both] == [frozenset(), {"parameter_error"}]
  assert [kinds_of(terms) for terms, _ in one] == [{"parameter_error"}]


def test_fits_are_drawn_as_often_as_they_are_likely(near):
  drawn, _ = near
  assert len(drawn) == _DRAWS
  costs = [item.fit.cost for item in drawn]
  assert costs == sorted(costs)
  for item in drawn:
    often = sum(item is other for other in drawn)
    first = sum(drawn[0] is other for other in drawn)
    assert often / first == pytest.approx(np.exp(costs[0] - item.fit.cost), abs=1.0 / first)
    assert item.names >= {"load_friction"}
    assert item.values("load_friction").keys() == {"coefficient", "quadratic", "rest", "velocity"}


def test_their_mean_predicts_a_motion_that_was_not_fitted(near):
  fits, _ = near
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  held = log_of(PENDULUM, "sweep", [RICH], seed=9)
  distinct = {id(item): item for item in fits}.values()
  members = [Member(*_simulated(item)) for item in distinct]
  errors = simulation.errors(model, [held], members)
  assert errors["after"] < 0.3 * simulation.error(model, [held])
  if len(members) > 1:
    assert errors["least"] <= errors["median"] <= errors["most"]
    assert errors["after"] <= errors["most"]
    assert errors["models"] == len(members)


def _simulated(item):
  effects, clocks = effects_of("joint", item)
  return effects, {"joint": clocks}


def test_the_error_of_one_model_is_its_own():
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log = log_of(PENDULUM, "slow", [RICH], duration=3.0)
  errors = simulation.errors(model, [log], [Member([], {})])
  own = pytest.approx(simulation.error(model, [log]))
  assert errors == {"before": own, "after": own}
  both = simulation.errors(model, [log], [Member([RICH], {}), Member([], {})])
  course = [simulation.simulate(model, log, e)[:, 0] for e in ([RICH], [])]
  mean = np.sqrt(np.mean((np.mean(course, axis=0) - log.states.position[:, 0]) ** 2))
  assert both["after"] == pytest.approx(float(mean), rel=1e-6)
  assert both["single"] < both["after"] < both["most"]
  often = simulation.errors(model, [log], [Member([RICH], {}, 3), Member([], {}, 1)])
  mean = 0.75 * course[0] + 0.25 * course[1]
  own = np.sqrt(np.mean((mean - log.states.position[:, 0]) ** 2))
  assert often["after"] == pytest.approx(float(own), rel=1e-6)
