"""Whether a model's own step and soft friction pass for a machine's."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit import resolution
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.outputs import extended_model
from nerf2real.sysid.selection.joints.subject import prepare
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import log_of

AXIS = """
<mujoco model="axis">
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody><body name="stage">
    <joint name="joint" type="slide" axis="1 0 0" damping="20" armature="ARMATURE"
      frictionloss="FRICTION"/>
    <inertial pos="0 0 0" mass="2" diaginertia="1e-3 1e-3 1e-3"/>
  </body></worldbody>
  <actuator><position name="joint" joint="joint" kp="4000" kv="600"/></actuator>
</mujoco>"""
SMOOTH = AXIS.replace("ARMATURE", "0").replace("FRICTION", "0")
RUBBING = AXIS.replace("ARMATURE", "0.5").replace("FRICTION", "20")
LATE = Effect("command_delay", "joint", {"delay": 0.003})
RUBS = Effect("coulomb_friction", "joint", {"torque": 20.0})
MACHINE = Numerics(1e-4, prompt=True)


def recorded(xml, noise, *, effect=LATE, numerics=None):
  """Returns readings of what a model makes with an effect, by its own numerics or by others."""
  model = mujoco.MjModel.from_xml_string(xml)
  if numerics is not None:
    spec = mujoco.MjSpec.from_string(xml)
    numerics.write(spec)
    spec.compile()
    xml = spec.to_xml()
  logs = []
  for seed, kind in enumerate(("sweep", "slow", "steps")):
    log = log_of(xml, kind, [effect], duration=6.0, seed=seed, rounding=0.0)
    read = np.random.default_rng(seed).normal(log.states.position, noise)
    states = dataclasses.replace(log.states, position=read)
    logs.append(dataclasses.replace(log, states=states))
  return model, logs


def left(model, logs):
  """Returns what constants within their tolerances leave of logs, over the noise."""
  return prepare("joint", Machine(model, logs), None, tried=1, settings=SETTINGS).left


@pytest.mark.parametrize(("xml", "prompt"), [(SMOOTH, False), (RUBBING, True)])
def test_a_healthy_machine_leaves_noise_where_its_model_is_simulated_finely(xml, prompt):
  model, logs = recorded(xml, 4e-6, numerics=MACHINE)
  found = resolution.numerics(Machine(model, logs))
  assert found.step < 4e-3 and found.prompt == prompt
  before = left(model, logs)
  found.apply(model)
  assert left(model, logs) < 1.2
  assert before > SETTINGS.more


def test_readings_that_do_not_show_a_model_s_numerics_leave_it_as_it_is():
  model, logs = recorded(RUBBING, 3e-2, numerics=MACHINE)
  assert resolution.numerics(Machine(model, logs)) == Numerics(4e-3)


@pytest.mark.parametrize("effect", [LATE, RUBS])
@pytest.mark.parametrize("xml", [SMOOTH, RUBBING])
def test_logs_of_a_simulation_have_its_numerics(xml, effect):
  model, logs = recorded(xml, 1e-5, effect=effect)
  assert resolution.numerics(Machine(model, logs)) == Numerics(4e-3)


def test_numerics_are_written_as_they_are_applied(tmp_path):
  (tmp_path / "model.xml").write_text(RUBBING)
  extended_model.write(tmp_path / "model.xml", tmp_path / "fine.xml", [], numerics=MACHINE)
  written = mujoco.MjModel.from_xml_path(str(tmp_path / "fine.xml"))
  model = mujoco.MjModel.from_xml_string(RUBBING)
  MACHINE.apply(model)
  assert written.opt.timestep == model.opt.timestep == 1e-4
  np.testing.assert_allclose(written.dof_solref, model.dof_solref)
  np.testing.assert_allclose(written.dof_solimp, model.dof_solimp)
