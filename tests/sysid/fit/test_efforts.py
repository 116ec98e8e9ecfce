"""Efforts, whose unit no log tells, against made torques."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from tests.sysid.synthetic import PENDULUM, log_of


@pytest.fixture(scope="module")
def felt():
  """A joint whose efforts are 0.4 of its torques and something else."""
  logs = [log_of(PENDULUM, kind, duration=5.0) for kind in ("sweep", "steps")]
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  plant, felt = JointModel(model, "joint", logs), []
  for index, log in enumerate(logs):
    torque = plant.run(plant.declared, (), index, follow=True).torque[:, None]
    effort = 0.4 * torque + 0.05 * np.sin(5.0 * log.states.position)
    felt.append(dataclasses.replace(log, states=dataclasses.replace(log.states, effort=effort)))
  return JointLikelihood(JointModel(model, "joint", felt))


def _halved(joint):
  """Returns constants and their values [2, n] as declared and with half of all torques."""
  own = constants(joint.plant, healthy=True)
  scaled = [n in ("damping", "armature", "friction", "gain", "mass") for n in own.names]
  assert sum(scaled) == 5
  return own, np.outer([0.0, -0.5], scaled)


def test_all_torques_larger_by_one_factor_leave_the_same_of_efforts(felt):
  """Their scale is not known, so that efforts must not tell it either."""
  own, values = _halved(felt)
  one, other = felt.residuals((own,), values)
  apart = np.sqrt(np.mean((one - other) ** 2, axis=1) / np.mean(one**2, axis=1))
  assert (apart < 0.05).all()  # a constraint's softness is of the declared inertia


def test_beside_a_reference_efforts_tell_how_large_torques_are(felt):
  """Of a motor with half of its gain the current tells it, or is as large as before."""
  own, values = _halved(felt)
  weaker = [t for t in candidates.library(felt.plant) if t.kind == "motor_gain"]
  gain = next(t for t in weaker if dict(t.fixed)["scales_limit"])
  unit = felt.effort_factor((own,), values[0])
  assert unit == pytest.approx(0.4, rel=0.1)

  def left(terms, x, factor):
    felt.effort.unit = factor * unit
    try:
      return float(np.sqrt(np.mean(felt.residuals(terms, x[None])[0, 1] ** 2)))
    finally:
      felt.effort.unit = None

  usual = left((own,), values[0], 1.0)
  assert left((own,), values[1], 1.0) > 5.0 * usual
  weak = np.append(values[0], 0.5)
  untold, told, neither = (left((own, gain), weak, factor) for factor in (1.0, 2.0, 0.5))
  assert max(told, untold) < 1.2 * usual < 5.0 * usual < neither


def test_a_late_encoder_makes_no_effort_late():
  """Its back-EMF goes with the speed at the time of the effort."""
  delay = Effect("measurement_delay", "joint", {"delay": 0.03})
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  log, read = (
    log_of(PENDULUM, "sweep", duration=5.0),
    log_of(PENDULUM, "sweep", [delay], duration=5.0),
  )
  own = JointModel(model, "joint", [log])
  torque = own.run(own.declared, (), 0, follow=True).torque - own.logs[0].velocity  # of a current
  states = dataclasses.replace(read.states, effort=torque[:, None])
  joint = JointLikelihood(JointModel(model, "joint", [dataclasses.replace(read, states=states)]))
  term = next(t for t in candidates.library(joint.plant) if t.kind == "measurement_delay")
  there, none = joint.residuals((term,), np.array([[0.03], [0.0]]))[:, 1]
  assert np.std(there[50:-50]) < 0.1 * np.std(torque)
  assert np.std(there[50:-50]) < 0.2 * np.std(none[50:-50])
