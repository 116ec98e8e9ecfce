"""What no machine does is refused or said, and what faulty machines do is not."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import LogError
from nerf2real.suite.effects import Effect
from nerf2real.sysid.data.compatibility import check_against_model
from nerf2real.sysid.data.following import following
from nerf2real.sysid.data.opening import load_model, read_logs
from nerf2real.sysid.data.plausibility import check_plausible, doubts, spikes
from tests.sysid.synthetic import ARM, PENDULUM, log_of

DEGREES = 180.0 / np.pi
SAMPLES = Path(__file__).parents[4] / "shared/data"
MODEL = mujoco.MjModel.from_xml_string(PENDULUM)


def with_states(log, position=None, **changes):
  """Returns a log with other readings."""
  changes |= {} if position is None else {"position": position}
  return dataclasses.replace(log, states=dataclasses.replace(log.states, **changes))


def with_commands(log, scale):
  """Returns a log whose commands are scaled."""
  position = scale * log.commands.position
  return dataclasses.replace(log, commands=dataclasses.replace(log.commands, position=position))


@pytest.fixture(scope="module")
def slow():
  return log_of(PENDULUM, "slow", rounding=0.0)


@pytest.fixture(scope="module")
def swept():
  return log_of(PENDULUM, "sweep", rounding=0.0)


def test_how_a_servo_follows_is_read_off(slow):
  found = following(slow, MODEL, "joint")
  assert found.along.share > 0.999 and found.along.slope == pytest.approx(0.96, abs=0.02)
  assert 0.03 < found.along.lag < 0.08 and found.against.share == 0.0
  late = following(with_states(slow, stamp=slow.states.stamp + 0.1), MODEL, "joint")
  assert late.along.lag == pytest.approx(found.along.lag + 0.1, abs=0.006)
  assert following(with_states(slow, 0.0 * slow.states.position), MODEL, "joint") is None


def test_degrees_are_refused(slow):
  readings = with_states(slow, DEGREES * slow.states.position)
  for log, said in (
    (readings, "its readings are 5.* times its commands: the readings are in degrees at 'joint'"),
    (with_commands(slow, DEGREES), "are 1/5.* of its commands: the commands are in degrees"),
  ):
    with pytest.raises(LogError, match=said) as caught:
      check_against_model(log, MODEL)
    assert "\n" not in str(caught.value) and "`position:joint [deg]`" in str(caught.value)


def test_a_joint_without_a_range_may_be_fast_and_is_told(swept):
  both = with_states(swept, DEGREES * swept.states.position)
  both = with_commands(both, DEGREES)
  check_against_model(both, MODEL)
  assert any("rad/s over more than two turns: if" in text for text in doubts([both], MODEL))
  assert not any("rad/s" in text for text in doubts([swept], MODEL))


def test_degrees_beyond_a_declared_range_are_said_to_be_degrees(slow):
  limited = PENDULUM.replace('axis="0 1 0"', 'axis="0 1 0" range="-60 60"')
  model = mujoco.MjModel.from_xml_string(limited)
  check_against_model(slow, model)
  readings = with_states(slow, DEGREES * slow.states.position)
  for log in (readings, with_commands(readings, DEGREES)):
    with pytest.raises(LogError, match="readings are in degrees"):
      check_against_model(log, model)


def test_the_other_sign_and_whole_turns_are_refused(slow, monkeypatch):
  flipped = with_states(slow, -slow.states.position)
  for log, said in (
    (flipped, "readings of joint go against their commands"),
    (with_states(slow, slow.states.position + 2 * np.pi), r"\+1 times 2 pi, .* take 6.283 off"),
    (with_states(slow, slow.states.position - 4 * np.pi), r"-2 times 2 pi, .* take -12.57 off"),
  ):
    monkeypatch.setattr("nerf2real.sysid.data.opening.read_log", lambda _, log=log: log)
    with pytest.raises(LogError, match=said) as caught:
      read_logs([Path("slow.mcap")], MODEL)
    assert "\n" not in str(caught.value)
  check_plausible([with_commands(flipped, -1.0)], MODEL)


def test_the_other_sign_of_one_joint_of_two_is_said():
  model, log = mujoco.MjModel.from_xml_string(ARM), log_of(ARM, "slow")
  assert not doubts([log], model)
  turned = with_states(log, log.states.position * (1.0, -1.0))
  check_plausible([turned], model)
  (said,) = doubts([turned], model)
  assert said.startswith("slow.mcap: readings of elbow go against their commands, and those of")
  with pytest.raises(LogError, match="readings of shoulder, elbow go against"):
    check_plausible([with_states(log, -log.states.position)], model)


def test_stamps_of_the_writing_are_refused(slow):
  for share, refused in ((0.5, True), (0.01, False)):
    stamp = slow.states.stamp.copy()
    same = 1 + 2 * np.arange(round(share * len(stamp)) - 1)
    stamp[same] = stamp[same - 1]
    log = with_states(slow, stamp=stamp)
    if refused:
      with pytest.raises(LogError, match="50% of .* stamps are of the writing, not of the reading"):
        check_plausible([log], MODEL)
    else:
      check_plausible([log], MODEL)


def test_readings_before_their_commands_are_said(slow):
  (said,) = doubts([with_states(slow, stamp=slow.states.stamp - 0.08)], MODEL)
  assert "readings of joint come up to" in said and "ms before the commands" in said
  assert not doubts([with_states(slow, stamp=slow.states.stamp + 0.08)], MODEL)


def test_lost_readings_are_said(slow):
  position = slow.states.position.copy()
  lost = np.arange(50, 700, 90)
  position[lost] = 0.0
  far = lost[np.abs(slow.states.position[lost, 0]) > 0.1]
  assert set(far) <= set(spikes(position[:, 0])) <= set(lost) and len(far) > 3
  (said,) = doubts([with_states(slow, position)], MODEL)
  assert f"{len(spikes(position[:, 0]))} single readings of joint leave" in said
  assert "return, all at 0: they were not read" in said
  counts = np.random.default_rng(0).integers(-1, 2, 800) * 0.0015  # of a still joint
  assert not len(spikes(counts)) and not len(spikes(np.zeros(800))) and not len(spikes(counts[:4]))


def test_commands_that_end_early_are_said(slow):
  told = slow.commands.stamp < 4.0

  def cut(log):
    commands = log.commands
    stamp, position = commands.stamp[told], commands.position[told]
    commands = dataclasses.replace(commands, stamp=stamp, log_time=stamp, position=position)
    return dataclasses.replace(log, commands=commands)

  (said,) = doubts([cut(slow)], MODEL)
  assert said.startswith("slow.mcap: commands end at 3.98 s, while joint go on moving until 7.97 s")
  settled = np.where(slow.states.stamp[:, None] < 4.2, slow.states.position, 0.3)
  assert not doubts([cut(with_states(slow, settled))], MODEL)  # told once, where it stays


@pytest.mark.parametrize(
  "effect",
  [
    Effect("motor_gain", "joint", {"gain": 0.3, "scales_limit": 0.0}),
    Effect("command_delay", "joint", {"delay": 0.15}),
    Effect("measurement_delay", "joint", {"delay": 0.15}),
    Effect("backlash", "joint", {"gap": 0.15, "stiffness": 200.0, "damping": 0.5}),
    Effect("encoder_offset", "joint", {"offset": 0.8}),
    Effect("payload", "arm", {"mass": 2.0, "x": 0.0, "y": 0.0, "z": -0.2}),
    Effect("coulomb_friction", "joint", {"torque": 2.0}),
    Effect("torque_limit", "joint", {"limit": 0.7}),
    Effect("spring", "joint", {"stiffness": 20.0, "reference": 0.5}),
  ],
  ids=lambda effect: effect.kind,
)
def test_faulty_machines_are_neither_refused_nor_doubted(effect):
  logs = [
    dataclasses.replace(log_of(PENDULUM, kind, [effect], seed=i), name=kind)
    for i, kind in enumerate(("sweep", "slow", "steps"))
  ]
  for log in logs:
    check_against_model(log, MODEL)
    check_plausible([log], MODEL)
  assert not doubts(logs, MODEL)


@pytest.mark.parametrize("path", sorted(SAMPLES.glob("*/*/model.xml")), ids=lambda p: p.parent.name)
def test_the_shared_and_measured_logs_are_not_doubted(path):
  model = load_model(path)
  assert not doubts(read_logs(sorted(path.parent.glob("*.mcap")), model), model)
