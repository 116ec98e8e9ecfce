"""The likelihood by blocks and its mode, against hand computation and made logs."""

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.noise import correlation_time, once
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import PENDULUM, log_of


def joint_of(kinds=("sweep", "slow"), effects=()):
  logs = [log_of(PENDULUM, kind, effects, duration=5.0, seed=i) for i, kind in enumerate(kinds)]
  plant = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs)
  return plant, JointLikelihood(plant)


@pytest.fixture(scope="module")
def viscous():
  """A joint with viscous friction that its model lacks."""
  return joint_of(effects=[Effect("viscous_friction", "joint", {"coefficient": 0.5})])


def test_nats_of_a_block_are_those_of_the_formula(viscous):
  _, joint = viscous
  residuals = np.zeros((1, joint.size))
  chosen = joint.block_of == 2
  residuals[0, chosen] = 3.0 * joint.scale[0]
  squares = joint.squares(residuals)
  nats = joint.loglik(squares)
  expected = -joint.observations[0, 2] * np.log1p(squares[0, 2] / joint.scale[0] ** 2)
  assert nats[2] == pytest.approx(expected)
  assert np.all(np.delete(nats, 2) == 0.0)


def test_logs_are_folds_and_blocks_are_a_second(viscous):
  _, joint = viscous
  assert set(joint.fold) == {0, 1}
  assert np.median(np.diff(joint.starts)) == pytest.approx(100, abs=2)


def test_noise_of_blocks_is_what_readings_and_stamps_that_scatter_leave(viscous):
  plant, _ = viscous
  joint = JointLikelihood(plant)
  joint.stamp_noise = 5.0 * joint.position_noise / np.abs(joint.speed).max()
  shaky = joint.stamp_noise * joint.speed / joint.position_noise
  joint.gain = joint.mask[None] / np.sqrt(1.0 + shaky**2)
  joint._cut()
  random = np.random.default_rng(0)
  off = joint.position_noise * random.normal(size=(400, joint.size))
  off += joint.stamp_noise * joint.speed * random.normal(size=(400, joint.size))
  measured = joint.squares(off[:, None] * joint.gain)[:, 0].mean(axis=0)
  np.testing.assert_allclose(joint.noise_squares, measured, rtol=0.05)
  assert measured.max() > 2.0 * joint.position_noise**2


def test_correlation_time_of_an_autoregression():
  random, rho = np.random.default_rng(0), 0.8
  row = np.zeros(40_000)
  for n in range(1, len(row)):
    row[n] = rho * row[n - 1] + random.normal()
  assert correlation_time(row, 100) == pytest.approx((1 + rho) / (1 - rho), rel=0.25)
  assert correlation_time(random.normal(size=40_000), 100) < 1.2


def test_readings_that_repeat_the_one_before_are_one():
  np.testing.assert_allclose(once(np.array([4.0, 4.0, 4.0, 5.0, 4.0, 4.0])) * 6, [2, 2, 2, 6, 3, 3])
  plant, joint = joint_of(("sweep", "steps"))
  joint.rescale(np.random.default_rng(0).normal(size=(1, joint.size)))
  counted = [float(joint.observations[0, joint.log_of == index].sum()) for index in (0, 1)]
  moved = [np.count_nonzero(np.diff(log.position)) + 1 for log in plant.logs]
  assert moved[0] > 1.5 * moved[1]  # a joint that stands between steps
  assert counted[0] / counted[1] == pytest.approx(moved[0] / moved[1], rel=0.1)


def test_a_joint_s_damping_is_known_no_better_than_its_servo_s():
  xml = PENDULUM.replace('kp="21"', 'kp="2100" kv="50"')
  plant = JointModel(mujoco.MjModel.from_xml_string(xml), "joint", [log_of(xml, "sweep")])
  own = constants(plant)
  at, tolerance = own.names.index("damping"), dict(SETTINGS.tolerances)["damping"]
  assert own.prior[at] == pytest.approx(50 * tolerance, rel=1e-3)
  assert own.low[at] > -1.0 and own.scale[at] < own.high[at]


def test_only_a_reference_may_be_late_beyond_twice_the_tolerance_and_of_another_strength(viscous):
  plant, joint = viscous
  tolerance = dict(joint.settings.tolerances)
  for term, deviations, far in (
    (constants(plant), 2.0, 5.0 * tolerance["damping"]),
    (constants(plant, healthy=True), 5.0, 0.6),
  ):
    high = dict(zip(term.names, term.high, strict=True))
    assert high["latency"] == pytest.approx(deviations * tolerance["latency"])
    assert high["skew"] == pytest.approx(deviations * tolerance["skew"])
    assert high["damping"] == pytest.approx(far)


def test_the_mode_is_the_effect_that_is_there(viscous):
  plant, joint = viscous
  term = next(t for t in candidates.library(plant) if t.kind == "viscous_friction")
  fixed = constants(plant)
  layout = Layout([(fixed, term)])
  joint.rescale(joint.residuals((), np.zeros((1, 0)))[0])
  fitter = Fitter([joint], layout)
  start = np.concatenate([np.zeros(len(fixed.names)), term.starts[0]])
  for _ in range(4):
    fit = fitter.fit(start, iterations=4)
    joint.rescale(fit.residuals[0])
    start = fit.x
  assert fit.values(term)["coefficient"] == pytest.approx(0.5, rel=0.1)
  fitter.leave_out(fit)
  held = np.sqrt(fit.held[0][0].mean())
  assert held < 3.0 * joint.floor[0]


def test_efforts_count_no_more_often_than_courses(viscous):
  _, joint = viscous
  random = np.random.default_rng(0)
  smooth = np.convolve(random.normal(size=joint.size + 40), np.ones(41) / 41, "valid")
  joint.channels.append("effort")
  two = np.array([smooth, random.normal(size=joint.size)])
  try:
    joint.gain, joint.floor = np.ones((2, joint.size)), np.full(2, 1e-9)
    joint.counts, joint._further = np.repeat(joint.counts, 2, axis=0), np.zeros((2, joint.size))
    joint.rescale(two)
    course, effort = joint.observations[:, 2] / joint.counts[:, 2]
    assert course == effort < 0.1
    joint.rescale(two[::-1])
    course, effort = joint.observations[:, 2] / joint.counts[:, 2]
    assert effort < 0.1 < 0.5 < course
  finally:
    joint.channels.pop()


def test_stamps_matter_as_far_as_more_than_the_noise_remains():
  _, joint = joint_of()
  random = np.random.default_rng(0)
  fast = joint.block_of == 3
  joint._further = np.where(fast, 9.0 * joint.floor[0] ** 2, 0.0)[None]
  noise = random.normal(size=(1, joint.size)) * joint.floor[0] * np.where(fast, 0.316, 1.0)
  once = np.add.reduceat(joint._once[0], joint.starts)
  counted = []
  for residuals in (noise, noise + 100.0 * joint.floor[0] * random.normal(size=(1, joint.size))):
    joint.rescale(residuals)
    shares = joint.observations[0] / once  # of readings that do not repeat
    counted.append(shares[3] / shares[2])
  assert counted[0] == pytest.approx(0.1, abs=0.02)
  assert counted[1] == pytest.approx(1.0, abs=0.02)
