"""What a reference leaves, expected of logs with the same commands."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.expectation import NEIGHBOURS, NOISE, Expectation
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.model import kernel
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.measured import same_commands
from tests.sysid.fit.test_likelihood import joint_of
from tests.sysid.synthetic import COUNT, PENDULUM, log_of


@pytest.fixture(scope="module")
def swept():
  """A joint along two motions."""
  return joint_of()


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


def test_only_the_very_same_commands_are_the_same(swept):
  plant, _ = swept
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


@pytest.mark.parametrize("clock", ["command_delay", "measurement_delay"])
def test_what_a_reference_leaves_comes_as_late_as_what_it_goes_with(swept, clock):
  plant, _ = swept
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


def test_what_a_reference_leaves_of_efforts_comes_no_later_beside_a_late_encoder(swept):
  plant, _ = swept
  left = [(log.time, np.array([np.sin(3.0 * log.time)] * 2)) for log in plant.logs]
  expected = Expectation(plant.logs, left, plant.declared)
  late = plant.declared.copy()
  late[kernel.INDEX["measurement_delay"]] += 0.03
  course, effort = expected.under(late)
  times = np.concatenate([log.time for log in plant.logs])
  inner = np.concatenate([log.time > 0.05 for log in plant.logs])
  np.testing.assert_allclose(course[inner], np.sin(3.0 * (times - 0.03))[inner], atol=3e-4)
  np.testing.assert_allclose(effort, np.sin(3.0 * times), atol=1e-5)


@pytest.mark.parametrize("later", [0.0, 0.25, 0.5])
def test_expected_noise_is_the_same_wherever_between_readings_it_is_taken(swept, later):
  """Else a delay of half a period would be likelier than one of a whole one."""
  plant, _ = swept
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
def test_what_is_expected_goes_on_where_readings_of_a_reference_were_lost(swept, lost):
  plant, _ = swept
  log = dataclasses.replace(plant.logs[0], time=0.01 * np.arange(len(plant.logs[0].time)))
  kept = (log.time < lost[0]) | (log.time > lost[1])
  line = 2.0 + 3.0 * log.time
  expected = Expectation([log], [(log.time[kept], line[None, kept])], plant.declared)
  seen = log.time <= log.time[kept][-1]
  np.testing.assert_allclose(expected.under(plant.declared)[0, seen], line[seen], atol=1e-9)
