"""What logs can show, against dense algebra and motions that are known to lack something."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest

from nerf2real.core.serialization import to_plain
from nerf2real.sysid.design import excitation, identifiability
from nerf2real.sysid.design.information import Place, beside, information
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.report import capability
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import ARM, COUNT, PENDULUM, log_of

MODEL = mujoco.MjModel.from_xml_string(PENDULUM)


def term(kind, names, start):
  count = len(names)
  return Term(kind, "joint", names, (0.0,) * count, (9.0,) * count, (0.1,) * count, (start,))


@pytest.fixture
def linear():
  """Readings that are linear in every value, the places of two effects, and the vectors."""
  random = np.random.default_rng(0)
  vectors = {"calibration": random.normal(size=50), "coulomb_friction": random.normal(size=50)}
  vectors["viscous_friction"] = vectors["coulomb_friction"] + 0.3 * random.normal(size=50)
  own = Term("calibration", "joint", ("damping",), (-1.0,), (1.0,), (0.1,), ((0.0,),), (0.2,))
  chosen = [
    Place(term("coulomb_friction", ("torque",), (0.5,)), (0.5,)),
    Place(term("viscous_friction", ("coefficient",), (0.1,)), (0.1,)),
  ]

  def readings(terms, x):
    parts = [t for t in terms if t.names]
    return np.sum([v * vectors[t.kind] for t, v in zip(parts, x, strict=True)], axis=0)[None]

  return readings, own, chosen, vectors


def test_information_is_that_of_noise_and_tolerances_together(linear):
  readings, own, chosen, vectors = linear
  noise = 0.7
  got = information(readings, own, chosen, noise=np.array([noise]), count=50.0)
  u = np.array([0.5 * vectors["coulomb_friction"], 0.1 * vectors["viscous_friction"]])
  a = 0.2 * vectors["calibration"]
  covariance = 50.0 * noise**2 * np.eye(50) + np.outer(a, a)
  np.testing.assert_allclose(got, u @ np.linalg.solve(covariance, u.T), rtol=1e-10)


def test_what_a_rival_leaves_is_what_its_projection_leaves(linear):
  readings, own, chosen, vectors = linear
  matrix = information(readings, own, chosen, noise=np.array([1.0]), count=1.0)
  a = 0.2 * vectors["calibration"]
  root = np.linalg.cholesky(np.linalg.inv(np.eye(50) + np.outer(a, a)))
  one, other = (
    root.T @ v for v in (0.5 * vectors["coulomb_friction"], vectors["viscous_friction"])
  )
  left = one - other * (one @ other) / (other @ other)
  assert beside(matrix, 0, [1]) == pytest.approx(left @ left, rel=1e-9)
  assert beside(matrix, 0, [0]) == pytest.approx(0.0, abs=1e-9)


def driven(command, rate=50.0):
  """Returns a log of a pendulum under commands [T]."""
  log = log_of(PENDULUM, "slow", duration=len(command) / rate)
  commands = dataclasses.replace(
    log.commands,
    log_time=np.arange(len(command)) / rate,
    stamp=np.arange(len(command)) / rate,
    position=command[:, None],
  )
  log = dataclasses.replace(log, commands=commands)
  positions = np.round(simulation.simulate(MODEL, log) / COUNT) * COUNT
  return dataclasses.replace(log, states=dataclasses.replace(log.states, position=positions))


def triangle(duration=8.0):
  time = np.arange(0.0, duration, 0.02)
  return driven(0.6 * np.arcsin(np.sin(2 * np.pi * 0.25 * time)))


def shown_by(*logs, repeated=False):
  (found,) = identifiability.of_machine(Machine(MODEL, logs), repeated=repeated, settings=SETTINGS)
  return found, {effect.kind: effect for effect in found.effects}


def test_constant_speed_does_not_tell_viscous_from_coulomb_friction():
  pair = ("coulomb_friction", "viscous_friction")
  slow, of_slow = shown_by(triangle())
  every, of_every = shown_by(triangle(), log_of(PENDULUM, "sweep"), log_of(PENDULUM, "steps"))
  assert pair in slow.pairs
  assert pair not in every.pairs
  assert "coulomb_friction and viscous_friction" in capability.sentence([slow])
  assert any(pair in entries for entries in slow.resolved.values())
  assert of_slow["coulomb_friction"].cosine > of_every["coulomb_friction"].cosine


def test_a_late_reading_looks_like_a_late_command():
  found, effects = shown_by(log_of(PENDULUM, "sweep"), log_of(PENDULUM, "slow"))
  assert ("command_delay", "measurement_delay") in found.pairs
  assert effects["measurement_delay"].nearest == "command_delay"
  assert 1e-4 < effects["command_delay"].visible["delay"] < 0.006


def test_a_motion_that_is_proposed_resolves_what_it_says():
  slow, _ = shown_by(triangle())
  assert slow.motion is not None and slow.covered
  assert slow.motion in capability.sentence([slow])
  positions = triangle().states.position
  reach = float(np.ptp(positions)) / 2
  command = excitation.designs(0.0, reach, -reach, reach)[slow.motion]
  after, _ = shown_by(driven(command))
  left = set(after.pairs) | {(kind, "") for kind in after.hidden}
  promised = set(slow.resolved[slow.motion])
  assert len(promised & left) <= 0.2 * len(promised)


def test_a_joint_that_gravity_does_not_turn_shows_no_payload():
  upright = PENDULUM.replace('axis="0 1 0"', 'axis="0 0 1"').replace("0 0 -0.15", "0 0 0.15")
  model = mujoco.MjModel.from_xml_string(upright)
  logs = [log_of(upright, kind, duration=6.0) for kind in ("sweep", "steps")]
  (found,) = identifiability.of_machine(Machine(model, logs), repeated=False, settings=SETTINGS)
  assert "gravity_tilt" in found.hidden and "encoder_offset" in found.hidden
  assert (
    "gravity_tilt" not in shown_by(*(log_of(PENDULUM, k) for k in ("sweep", "steps")))[0].hidden
  )


def test_references_make_smaller_effects_visible():
  logs = [log_of(PENDULUM, kind, duration=6.0) for kind in ("sweep", "steps")]
  alone, beside_reference = (shown_by(*logs, repeated=r)[1] for r in (False, True))
  gains = [beside_reference[k].information / alone[k].information for k in alone]
  assert min(gains) > 1.0 - 1e-9
  assert max(gains) > 1.5


def test_joints_are_counted_in_the_sentence_and_written_as_json():
  model = mujoco.MjModel.from_xml_string(ARM)
  logs = [log_of(ARM, "slow", duration=6.0)]
  found = identifiability.of_machine(Machine(model, logs), repeated=False, settings=SETTINGS)
  assert [item.joint for item in found] == ["shoulder", "elbow"]
  words = capability.sentence(found)
  assert words.startswith("Of ") and words.count("These logs") <= 1
  plain = json.loads(json.dumps(to_plain(found), allow_nan=False))
  assert plain[0]["joint"] == "shoulder" and plain[0]["effects"][0]["information"] > 0


def test_the_check_simulates_each_value_a_few_times(monkeypatch):
  logs = [log_of(PENDULUM, kind, duration=6.0) for kind in ("sweep", "slow", "steps")]
  simulated, residuals = [], JointLikelihood.residuals

  def counted(self, terms, xs):
    simulated.append(len(xs))
    return residuals(self, terms, xs)

  monkeypatch.setattr(JointLikelihood, "residuals", counted)
  effects = shown_by(*logs)[1]
  assert len(effects) < sum(simulated) < 10 * len(effects)
