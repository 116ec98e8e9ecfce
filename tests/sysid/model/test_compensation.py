"""A machine whose firmware lifts its weight, against plain MuJoCo told what firmware knows."""

import mujoco
import numpy as np
import pytest

from nerf2real.core.geometry.rotations import matrix_from_rotvec
from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.sysid.model.joint import JointModel, Load
from nerf2real.sysid.model.kernel import INDEX as I
from nerf2real.sysid.model.reduction import Reduction
from nerf2real.sysid.outputs import extended_model
from tests.sysid.synthetic import ARM, PENDULUM, log_of

LIFTED = ARM.replace('<body name="upper"', '<body name="upper" gravcomp="0.9"').replace(
  '<body name="lower"', '<body name="lower" gravcomp="1.1"'
)
PAYLOAD = Effect("payload", "lower", {"mass": 0.2, "x": 0.03, "y": 0.05, "z": -0.1})
TILT = Effect("gravity_tilt", None, {"x": 0.1, "y": -0.06})
OFFSET = Effect("encoder_offset", "shoulder", {"offset": 0.15})
SIZES = np.array([0.3, 0.2])


def swing(model, apply=lambda data: None, *, step=None):
  """Returns where the arm goes under waves [T, 2]; `apply` writes what MuJoCo does not know."""
  data, path = mujoco.MjData(model), []
  for index in range(1500):
    command = SIZES * np.sin(2 * np.pi * np.array([0.9, 1.3]) * 1e-3 * index)
    if step is None:
      data.ctrl[:] = command
      apply(data)
    else:
      step(data, command)
    mujoco.mj_step(model, data)
    path.append(data.qpos.copy())
  return np.array(path)


def suites(effect):
  model = mujoco.MjModel.from_xml_string(LIFTED)
  return swing(model, step=EffectStack([effect]).bind(model).before_step)


def test_a_payload_that_is_not_declared_is_not_lifted(tmp_path):
  spec = mujoco.MjSpec.from_string(LIFTED)
  place = [PAYLOAD.parameters[axis] for axis in "xyz"]
  point = dict(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-4, 0, 0], contype=0, conaffinity=0)
  spec.body("lower").add_body(pos=place).add_geom(mass=0.2, **point)
  want = swing(spec.compile())
  np.testing.assert_allclose(suites(PAYLOAD), want, atol=1e-6)
  (tmp_path / "lifted.xml").write_text(LIFTED)
  assert extended_model.write(tmp_path / "lifted.xml", tmp_path / "with.xml", [PAYLOAD]) == []
  written = mujoco.MjModel.from_xml_path(str(tmp_path / "with.xml"))
  np.testing.assert_allclose(swing(written), want, atol=1e-6)


def test_a_mass_that_is_off_is_lifted_as_it_is_declared(tmp_path):
  off = Effect("parameter_error", "elbow", {"mass": 1.3})
  (tmp_path / "lifted.xml").write_text(LIFTED)
  assert extended_model.write(tmp_path / "lifted.xml", tmp_path / "with.xml", [off]) == []
  written = mujoco.MjModel.from_xml_path(str(tmp_path / "with.xml"))
  model = mujoco.MjModel.from_xml_string(LIFTED)
  lifts = model.body_mass * model.body_gravcomp
  np.testing.assert_allclose(written.body_mass * written.body_gravcomp, lifts, rtol=1e-5)
  assert written.body("lower").mass[0] == pytest.approx(1.3 * model.body("lower").mass[0])
  np.testing.assert_allclose(suites(off), swing(written), atol=1e-6)


def test_firmware_lifts_against_the_declared_gravity(tmp_path):
  model = mujoco.MjModel.from_xml_string(LIFTED)
  lift = -(model.body_mass * model.body_gravcomp)[:, None] * model.opt.gravity
  model.body_gravcomp[:] = 0
  model.opt.gravity[:] = matrix_from_rotvec([0.1, -0.06, 0.0]) @ model.opt.gravity

  def apply(data):
    data.xfrc_applied[:, :3] = lift

  np.testing.assert_allclose(suites(TILT), swing(model, apply), atol=1e-6)
  (tmp_path / "lifted.xml").write_text(LIFTED)
  assert extended_model.write(tmp_path / "lifted.xml", tmp_path / "with.xml", [TILT]) == [TILT]


def test_firmware_lifts_what_is_where_its_encoders_read():
  known, real = (mujoco.MjModel.from_xml_string(LIFTED) for _ in range(2))
  real.body_gravcomp[:] = 0
  real.actuator_biasprm[0, 0] += real.actuator_biasprm[0, 1] * 0.15
  read = mujoco.MjData(known)

  def apply(data):
    read.qpos[:] = data.qpos + np.array([0.15, 0.0])
    mujoco.mj_forward(known, read)
    data.qfrc_applied[:] = read.qfrc_gravcomp

  np.testing.assert_allclose(suites(OFFSET), swing(real, apply), atol=1e-6)


@pytest.mark.parametrize("by_motor", [False, True])
def test_what_a_joint_feels_is_lifted_as_by_mujoco(by_motor):
  told = '<joint actuatorgravcomp="true" damping' if by_motor else "<joint damping"
  xml = LIFTED.replace("<joint damping", told)
  model = mujoco.MjModel.from_xml_string(xml)
  log = log_of(xml, "sweep", duration=2.0)
  reduction, data = Reduction(model, log), mujoco.MjData(model)
  for index, joint in enumerate(log.joints):
    lift = reduction.compensation(joint)
    for n in reduction._knots[::7]:
      data.qpos[:] = reduction.detailed.position[n]
      mujoco.mj_forward(model, data)
      assert lift.here[n] == pytest.approx(data.qfrc_gravcomp[index], abs=1e-9)


@pytest.mark.parametrize("by_motor", [False, True])
@pytest.mark.parametrize("effect", [None, "payload", "encoder_offset"])
def test_a_joint_alone_moves_as_in_mujoco(by_motor, effect):
  xml = PENDULUM.replace('<body name="arm"', '<body name="arm" gravcomp="0.8"')
  if by_motor:
    xml = xml.replace("<joint ", '<joint actuatorgravcomp="true" ')
  model = mujoco.MjModel.from_xml_string(xml)
  values = {"payload": {"mass": 0.3, "z": -0.1}, "encoder_offset": {"offset": 0.2}}
  true = [Effect(effect, "joint", values[effect])] if effect else []
  log = log_of(xml, "sweep", true, duration=4.0, rounding=0.0)
  without = log_of(xml, "sweep", duration=4.0, rounding=0.0)
  plant = JointModel(model, "joint", [log])
  p, loads = plant.declared.copy(), ()
  if effect == "encoder_offset":
    p[I["encoder_offset"]] = 0.2
  if effect == "payload":
    moments = 0.3 * np.array([1, 0, 0, -0.1, 0, 0, 0.01, 0, 0, 0])
    loads = (Load("joint", moments),)
  out = plant.run(p, loads, 0)
  missed = out.position - log.states.position[:, 0]
  moved = without.states.position[:, 0] - log.states.position[:, 0]
  assert effect is None or np.abs(moved).max() > 0.02
  assert np.sqrt(np.mean(missed**2)) < 1e-5
