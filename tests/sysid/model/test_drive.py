"""What drives the joints of a model along a log."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.sysid.model.drive import mean_commands
from nerf2real.sysid.model.measured import measured
from nerf2real.sysid.model.motion import smooth_motion
from tests.sysid.synthetic import PENDULUM, log_of


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
  np.testing.assert_allclose(mean_commands(model, log, np.array([0.5]), 0.001), value)
  assert set(measured(log, smooth_motion(log), "joint", model).command) == {value}
