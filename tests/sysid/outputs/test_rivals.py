"""Alternatives that the report lists."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.likelihood import JointLikelihood, rms_of
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.outputs import rivals
from tests.sysid.synthetic import PENDULUM, log_of


def test_alternatives_that_predict_the_same_are_listed_first():
  kinds = [frozenset(name) for name in "abcdefgh"]
  all_of_them = [SimpleNamespace(names=names) for names in kinds]  # the likeliest first
  item = SimpleNamespace(alternatives=all_of_them, confounded=[SimpleNamespace(names=kinds[7])])
  assert [min(other.names) for other in rivals._listed(item)] == list("habcde")


def test_what_remains_is_stated_as_it_was_measured():
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  rough = Effect("coulomb_friction", "joint", {"torque": 0.2})
  logs = [log_of(PENDULUM, kind, [rough], duration=4.0) for kind in ("sweep", "slow")]
  joint = JointLikelihood(JointModel(model, "joint", logs))
  joint.mask[:] = joint.gain[0] = 0.1  # what a sample weighs is no size
  left = joint.courses((), np.zeros(0))
  assert rms_of(left) == pytest.approx(simulation.error(model, logs), rel=0.02)


def test_where_a_residual_sits_is_told_without_the_force_that_takes_it():
  """A stop at one end, which a force of any form imitates: what that leaves is elsewhere."""
  time = np.linspace(0.0, 10.0, 1000)
  log = SimpleNamespace(position=np.sin(time), velocity=np.cos(time), time=time, name="a.mcap")
  courses = {"force": 0.01 * (log.position < -0.8), "plain": 0.1 * (log.position > 0.8)}
  likelihood = SimpleNamespace(
    plant=SimpleNamespace(logs=[log]), courses=lambda terms, _: [courses[terms]]
  )
  force, idle, plain = (
    SimpleNamespace(terms=terms, fit=SimpleNamespace(x=None), beside_force=beside, neutral=neutral)
    for terms, beside, neutral in (
      ("force", True, False),
      ("force", False, True),
      ("plain", False, False),
    )
  )
  item = SimpleNamespace(
    joint="lift", likelihood=likelihood, extended=force, ranked=[force, idle, plain]
  )
  at = rivals.residual_at(SimpleNamespace(least_explained=item))
  assert at["position"]["low"] > 0.8 and at["position"]["share_of_square"] > 0.75
  item.extended = plain
  assert rivals.residual_at(SimpleNamespace(least_explained=item)) == at
