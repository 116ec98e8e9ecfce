"""The likelihood by blocks and its mode, against hand computation and made logs."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.expectation import NEIGHBOURS, NOISE, Expectation
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.noise import correlation_time, once
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model import kernel
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.measured import same_commands
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import COUNT, PENDULUM, log_of


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


def test_a_recording_may_be_as_late_as_references_are_among_each_other():
  made = [log_of(PENDULUM, kind, duration=5.0, seed=i) for i, kind in enumerate(("sweep", "slow"))]
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  reference, now = (JointLikelihood(JointModel(model, "joint", made)) for _ in range(2))
  late = np.array([0.001, -0.001])
  left = np.zeros((1, reference.size))
  left[0] = late[reference.log_at] * reference.speed
  assert now.expect(reference, left * reference.gain)
  terms, none = (), np.zeros((1, 0))
  expected = now.residuals(terms, none)[0, 0]
  now.expectation.apart = 0.0
  other = now.residuals(terms, none)[0, 0]
  assert np.sqrt(np.mean(expected**2)) < 0.7 * np.sqrt(np.mean(other**2))
  assert now.expect(reference, np.zeros_like(left)) and now.expectation.apart == 0.0


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


def test_only_the_very_same_commands_are_the_same(viscous):
  plant, _ = viscous
  sweep, slow = plant.logs
  assert same_commands(sweep, sweep)
  assert not same_commands(sweep, slow)


def test_a_recorder_that_starts_earlier_has_thesame_commands():
  log, model = log_of(PENDULUM, "sweep", duration=5.0), mujoco.MjModel.from_xml_string(PENDULUM)
  later = {
    name: dataclasses.replace(series, stamp=series.stamp + 0.37)
    for name, series in (("commands", log.commands), ("states", log.states))
  }
  before, now = (
    JointLikelihood(JointModel(model, "joint", [one]))
    for one in (dataclasses.replace(log, **later), log)
  )
  assert same_commands(now.plant.logs[0], before.plant.logs[0])
  wave = np.sin(3.0 * (before.plant.logs[0].time - 0.37))
  assert now.expect(before, (wave * before.gain[0])[None])
  expected = now.expectation.under(now.plant.declared)[0]
  inner = slice(20, -20)
  assert expected[inner] == pytest.approx(np.sin(3.0 * now.plant.logs[0].time)[inner], abs=1e-3)


def test_what_a_reference_leaves_cancels_beside_thesame_commands():
  effect = [Effect("cogging", "joint", {"amplitude": 0.1, "periods": 9.0, "phase": 0.3})]
  _, before = joint_of(effects=effect)
  _, now = joint_of(effects=effect)
  left = before.residuals((), np.zeros((1, 0)))[0]
  alone = np.sqrt(np.mean(now.residuals((), np.zeros((1, 0)))[0, 0] ** 2))
  assert now.expect(before, left)
  beside = np.sqrt(np.mean(now.residuals((), np.zeros((1, 0)))[0, 0] ** 2))
  # What is expected is smoothed: a part of the readings' rounding stays.
  assert beside < 0.6 * COUNT / np.sqrt(12.0) < 1e-3 < alone
  _, other = joint_of(kinds=("steps", "slow"), effects=effect)
  assert not other.expect(before, left)


@pytest.mark.parametrize("before_has_them", [True, False])
def test_of_efforts_that_one_side_lacks_nothing_is_expected(before_has_them):
  made = [log_of(PENDULUM, kind, duration=5.0) for kind in ("sweep", "slow")]
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  felt = [
    dataclasses.replace(
      log, states=dataclasses.replace(log.states, effort=np.sin(5.0 * log.states.position))
    )
    for log in made
  ]
  before, now = (
    JointLikelihood(JointModel(model, "joint", logs))
    for logs in ((felt, made) if before_has_them else (made, felt))
  )
  assert sorted((len(before.channels), len(now.channels))) == [1, 2]
  nothing = (), np.zeros((1, 0))
  alone = now.residuals(*nothing)[0]
  assert now.expect(before, before.residuals(*nothing)[0])
  beside = now.residuals(*nothing)[0]
  assert np.std(beside[0]) < 0.6 * np.std(alone[0])
  np.testing.assert_array_equal(beside[1:], alone[1:])


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
    felt.effort_unit = factor * unit
    try:
      return float(np.sqrt(np.mean(felt.residuals(terms, x[None])[0, 1] ** 2)))
    finally:
      felt.effort_unit = None

  usual = left((own,), values[0], 1.0)
  assert left((own,), values[1], 1.0) > 5.0 * usual
  weak = np.append(values[0], 0.5)
  untold, told, neither = (left((own, gain), weak, factor) for factor in (1.0, 2.0, 0.5))
  assert max(told, untold) < 1.2 * usual < 5.0 * usual < neither


@pytest.mark.parametrize("clock", ["command_delay", "measurement_delay"])
def test_what_a_reference_leaves_comes_as_late_as_what_it_goes_with(viscous, clock):
  plant, _ = viscous
  stamps = [log.time for log in plant.logs]
  left = [(t, np.array([np.sin(3.0 * t)])) for t in stamps]
  baseline, much_later = plant.declared.copy(), plant.declared.copy()
  baseline[kernel.INDEX[clock]], much_later[kernel.INDEX[clock]] = 0.004, 0.034
  expected = Expectation(plant.logs, left, baseline)
  as_was = np.sin(3.0 * np.concatenate(stamps))
  np.testing.assert_allclose(expected.under(baseline)[0], as_was, atol=1e-5)
  later = expected.under(much_later)[0]
  inner = np.concatenate([t > 0.05 for t in stamps])
  shifted = np.sin(3.0 * (np.concatenate(stamps) - 0.03))
  np.testing.assert_allclose(later[inner], shifted[inner], atol=3e-4)


def test_a_late_encoder_makes_no_effort_late(viscous):
  """Neither what a reference leaves of it, nor the speed that its back-EMF goes with."""
  plant, _ = viscous
  left = [(log.time, np.array([np.sin(3.0 * log.time)] * 2)) for log in plant.logs]
  expected = Expectation(plant.logs, left, plant.declared)
  late = plant.declared.copy()
  late[kernel.INDEX["measurement_delay"]] += 0.03
  course, effort = expected.under(late)
  times = np.concatenate([log.time for log in plant.logs])
  inner = np.concatenate([log.time > 0.05 for log in plant.logs])
  np.testing.assert_allclose(course[inner], np.sin(3.0 * (times - 0.03))[inner], atol=3e-4)
  np.testing.assert_allclose(effort, np.sin(3.0 * times), atol=1e-5)

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


@pytest.mark.parametrize("later", [0.0, 0.25, 0.5])
def test_expected_noise_is_the_same_wherever_between_readings_it_is_taken(viscous, later):
  """Else a delay of half a period would be likelier than one of a whole one."""
  plant, _ = viscous
  random, period = np.random.default_rng(0), 0.01
  stamps = [period * np.arange(len(log.time)) for log in plant.logs]
  noise = [random.normal(size=(200, len(t))) for t in stamps]
  logs = [dataclasses.replace(log, time=t) for log, t in zip(plant.logs, stamps, strict=True)]
  expected = Expectation(logs, list(zip(stamps, noise, strict=True)), plant.declared)
  p = plant.declared.copy()
  p[kernel.INDEX["command_delay"]] += later * period
  made = expected.under(p)[:, 20 : len(stamps[0]) - 20]
  assert np.mean(made**2) == pytest.approx(NOISE, rel=0.02)
  assert np.mean(made[:, 1:] * made[:, :-1]) == pytest.approx(NEIGHBOURS, rel=0.02)


@pytest.mark.parametrize("lost", [(0.5, 1.5), (0.505, 0.545), (2.0, 9.0)])
def test_what_is_expected_goes_on_where_readings_of_a_reference_were_lost(viscous, lost):
  plant, _ = viscous
  log = dataclasses.replace(plant.logs[0], time=0.01 * np.arange(len(plant.logs[0].time)))
  kept = (log.time < lost[0]) | (log.time > lost[1])
  line = 2.0 + 3.0 * log.time
  expected = Expectation([log], [(log.time[kept], line[None, kept])], plant.declared)
  seen = log.time <= log.time[kept][-1]
  np.testing.assert_allclose(expected.under(plant.declared)[0, seen], line[seen], atol=1e-9)


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
