"""What drives the joints of a model along a log."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.drive import Told
from nerf2real.sysid.model.measured import measured
from nerf2real.sysid.model.motion import smooth_motion
from tests.sysid.synthetic import ARM, PENDULUM, log_of


@pytest.mark.parametrize(
  ("actuator", "value"),
  [("<position kp='21'/>", 1.0), ("<velocity kv='2'/>", 2.0), ("<motor/>", 3.0)],
)
def test_commands_are_those_that_the_actuator_takes(actuator, value):
  log = log_of(PENDULUM, "slow", duration=1.2)
  fields = {"position": 1.0, "velocity": 2.0, "effort": 3.0}
  told = {name: np.full_like(log.commands.position, v) for name, v in fields.items()}
  log = dataclasses.replace(log, commands=dataclasses.replace(log.commands, **told))
  driven = f"{actuator.removesuffix('/>')} joint='joint'/>"
  xml = f"{PENDULUM[: PENDULUM.index('<actuator>')]}<actuator>{driven}</actuator></mujoco>"
  model = mujoco.MjModel.from_xml_string(xml)
  np.testing.assert_allclose(Told(model, log).mean(np.array([0.5]), 0.001), value)
  assert set(measured(log, smooth_motion(log), "joint", model).command) == {value}


def test_a_joint_that_is_not_commanded_is_held_where_it_was_and_not_judged():
  model, log = mujoco.MjModel.from_xml_string(ARM), log_of(ARM, "sweep", duration=2.0)
  states, commands = log.states, log.commands
  still = np.column_stack([states.position[:, 0], np.full(len(states.stamp), 0.5)])
  log = dataclasses.replace(
    log,
    states=dataclasses.replace(states, position=still),
    commands=dataclasses.replace(commands, joints=("shoulder",), position=commands.position[:, :1]),
  )
  positions = simulation.simulate(model, log)
  assert np.abs(positions[:, 1] - 0.5).max() < 0.1  # gravity and the other joint move it a little
  own = np.sqrt(np.mean((positions - still)[:, 0] ** 2))
  assert simulation.error(model, [log]) == pytest.approx(own)


def test_what_pulls_no_joint_is_late_for_none():
  """A tendon's and a body's number are no joint's, and may be beyond the last joint's."""
  pulls = "<actuator><adhesion body='lower' ctrlrange='0 1'/><position tendon='both' kp='2'/>"
  ties = "<tendon><fixed name='both'><joint joint='elbow' coef='1'/></fixed></tendon>"
  xml = ARM.replace("<actuator>", ties + pulls)
  model, log = mujoco.MjModel.from_xml_string(xml), log_of(ARM, "sweep", duration=1.2)
  late = [Effect("command_delay", "shoulder", {"delay": 0.02})]
  merged = simulation.merge_delays(late, {"elbow": simulation.Clocks(latency=0.01)}, model)
  assert {e.target: e.parameters["delay"] for e in merged} == {"shoulder": 0.02, "elbow": 0.01}
  assert len(merged) == 2
  assert simulation.simulate(model, log, late).shape == log.states.position.shape


def test_play_is_simulated_in_windows_that_begin_anew_as_in_one_of_its_own():
  """Effects write into actuators while they are simulated: what these are told is read before."""
  play = Effect("backlash", "joint", {"gap": 0.03, "encoder_on_motor": 0.0})
  xml = PENDULUM.replace("<position name", "<motor name").replace(' kp="21"', "")
  log = log_of(xml, "sweep", [play], duration=2.0)
  model = mujoco.MjModel.from_xml_string(xml)
  whole = simulation.simulate(model, log, [play], window_s=9.0)
  anew = simulation.simulate(model, log, [play], window_s=1.0)
  first = log.states.stamp < 0.9
  np.testing.assert_allclose(anew[first], whole[first], atol=1e-9)
  second = np.searchsorted(log.states.stamp, log.states.stamp[0] + 1.0)
  np.testing.assert_allclose(anew[second], log.states.position[second], atol=1e-3)
  assert np.abs(anew - log.states.position).max() < 0.03
