"""The robot against its link table, the paper's table and MuJoCo's own dynamics."""

import csv
import importlib.resources

import mujoco
import numpy as np
import pytest
from dm_control import composer, mjcf

from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.tasks.settings import PHYSICS_TIMESTEP
from nerf2real.suite.tasks.state import standing_posture


def _table():
  text = importlib.resources.files("suite.op3").joinpath("links.csv").read_text()
  return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


@pytest.fixture(scope="module")
def physics():
  arena = composer.Arena()
  arena.mjcf_model.compiler.set_attributes(boundmass=0, boundinertia=0)
  arena.mjcf_model.worldbody.add("geom", name="floor", type="plane", size=(3, 3, 0.1))
  arena.add_free_entity(op3.OP3())
  arena.mjcf_model.option.timestep = PHYSICS_TIMESTEP
  return mjcf.Physics.from_mjcf_model(arena.mjcf_model)


def _inertia(quaternion, moments):
  rotation = np.zeros(9)
  mujoco.mju_quat2Mat(rotation, quaternion)
  rotation = rotation.reshape(3, 3)
  return rotation @ np.diag(moments) @ rotation.T


def test_links_have_the_masses_inertias_frames_and_axes_of_the_table(physics):
  model = physics.model.ptr
  rows = _table()
  assert len(rows) == 21
  for row in rows:
    body = model.body(f"op3/{row['link']}")
    value = lambda *keys, row=row: np.array([float(row[key]) for key in keys])  # noqa: E731
    np.testing.assert_allclose(body.mass, value("mass"), rtol=1e-9)
    np.testing.assert_allclose(body.ipos, value("com_x", "com_y", "com_z"), atol=1e-9)
    quaternion = value("iq_w", "iq_x", "iq_y", "iq_z")
    expected = _inertia(quaternion / np.linalg.norm(quaternion), value("ixx", "iyy", "izz"))
    np.testing.assert_allclose(_inertia(body.iquat, body.inertia), expected, atol=1e-10)
    if row["joint"] != "free":
      np.testing.assert_allclose(body.pos, value("pos_x", "pos_y", "pos_z"), atol=1e-9)
      joint = model.joint(f"op3/{row['joint']}")
      np.testing.assert_allclose(joint.axis, value("axis_x", "axis_y", "axis_z"), atol=1e-9)
      assert model.body(int(model.body_parentid[body.id])).name == f"op3/{row['parent']}"
  assert model.body_subtreemass[0] == pytest.approx(sum(float(r["mass"]) for r in rows), rel=1e-9)
  assert model.body_subtreemass[0] == pytest.approx(3.14747)


def test_servos_are_p_only_with_the_declared_constants(physics):
  model = physics.model.ptr
  assert model.nu == model.njnt - 1 == 20
  for name in constants.JOINT_NAMES:
    actuator, joint = model.actuator(f"op3/{name}"), model.joint(f"op3/{name}")
    assert actuator.trnid[0] == joint.id
    assert actuator.gainprm[0] == 21.1
    np.testing.assert_array_equal(actuator.biasprm[:3], [0, -21.1, 0])
    np.testing.assert_array_equal(actuator.forcerange, [-4.1, 4.1])
    dof = int(model.jnt_dofadr[joint.id])
    assert model.dof_damping[dof] == 1.084
    assert model.dof_armature[dof] == 0.045
    assert model.dof_frictionloss[dof] == 0.03


def test_limits_are_the_papers_and_mirrored(physics):
  model = physics.model.ptr
  expected = {
    "head_pan": (-0.79, 0.79),
    "head_tilt": (-0.79, -0.157),
    "l_hip_roll": (-0.4, -0.1),
    "l_knee": (-0.2, 2.0),
    "r_hip_pitch": (-1.57, 0.45),
    "r_sho_roll": (-0.8, 0.0),
  }
  for name, limits in expected.items():
    np.testing.assert_array_equal(model.actuator(f"op3/{name}").ctrlrange, limits)
  for name in constants.JOINT_NAMES:
    if name.startswith("l_"):
      left, right = (constants.JOINT_NAMES.index(side + name[2:]) for side in ("l_", "r_"))
      assert constants.REFERENCE_POSE[left] == -constants.REFERENCE_POSE[right]
      if name != "l_hip_yaw":
        assert constants.LOWER_LIMITS[left] == -constants.UPPER_LIMITS[right]
  # The two printed references outside their ranges are kept for the reward and clipped for servos.
  outside = (constants.REFERENCE_POSE < constants.LOWER_LIMITS) | (
    constants.REFERENCE_POSE > constants.UPPER_LIMITS
  )
  assert {constants.JOINT_NAMES[i][2:] for i in np.flatnonzero(outside)} == {
    "hip_pitch",
    "hip_roll",
  }
  standing = dict(zip(constants.JOINT_NAMES, constants.standing_targets(), strict=True))
  assert standing["l_hip_pitch"] == -0.45 and standing["r_hip_roll"] == 0.1


def test_head_pan_limit_can_be_widened():
  robot = op3.OP3(head_pan_limit=2.5)
  assert robot.control_limits[0][0] == -2.5 and robot.control_limits[1][0] == 2.5
  assert op3.OP3().control_limits[1][0] == 0.79


def test_hip_pair_is_excluded_and_feet_are_the_published_boxes(physics):
  model = physics.model.ptr
  pairs = {
    frozenset((model.body(int(s) >> 16).name, model.body(int(s) & 0xFFFF).name))
    for s in model.exclude_signature
  }
  for side in "lr":
    assert frozenset((f"op3/{side}_hip_yaw_link", f"op3/{side}_hip_pitch_link")) in pairs
  left, right = model.geom("op3/l_ank_roll_link_0"), model.geom("op3/r_ank_roll_link_0")
  np.testing.assert_array_equal(left.size, [0.0635, 0.028, 0.004])
  np.testing.assert_array_equal(left.pos, [0.024, 0.013, -0.0265])
  np.testing.assert_array_equal(right.pos, [0.024, -0.013, -0.0265])


def test_stands_still_for_a_minute_on_its_feet_alone(physics):
  posture, targets = standing_posture(), constants.standing_targets()
  with physics.reset_context():
    physics.data.qpos[:7] = posture[:7]
    for name, value in zip(constants.JOINT_NAMES, posture[7:], strict=True):
      physics.named.data.qpos[f"op3/{name}"] = value
    physics.set_control(targets)
  physics.step(round(60 / physics.timestep()))
  assert physics.data.qpos[2] == pytest.approx(0.246, abs=0.001)
  np.testing.assert_allclose(physics.data.qpos[:2], 0.0, atol=0.005)
  joints = [physics.named.data.qpos[f"op3/{n}"] for n in constants.JOINT_NAMES]
  # Soft servos give way under the weight, by less than 2 degrees.
  np.testing.assert_allclose(np.ravel(joints), targets, atol=np.deg2rad(2))
  model, data = physics.model.ptr, physics.data.ptr
  assert np.abs(data.qvel).max() < 1e-3
  floor = int(np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)[0])
  touching = {
    model.body(int(model.geom_bodyid[g])).name
    for pair in data.contact.geom
    for g in pair
    if g != floor
  }
  assert touching == {"op3/l_ank_roll_link", "op3/r_ank_roll_link"}


def test_camera_looks_forward_from_the_head(physics):
  physics.reset()
  camera = physics.model.camera("op3/head_camera")
  head = physics.model.body("op3/head_tilt_link").id
  assert camera.bodyid[0] == head
  np.testing.assert_allclose(camera.pos, [0.01425, -0.019, 0.04975])
  assert camera.fovy[0] == pytest.approx(43.3)
  rotation = physics.data.cam_xmat[camera.id].reshape(3, 3)
  np.testing.assert_allclose(-rotation[:, 2], [1, 0, 0], atol=1e-9)  # looks along +x
  np.testing.assert_allclose(rotation[:, 1], [0, 0, 1], atol=1e-9)  # up is up
