"""Tests of the virtual robot's plant."""

import mujoco
import numpy as np
import pytest

from nerf2real.real.virtual.body import STEP, Body
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.suite.op3 import constants
from nerf2real.suite.tasks.state import standing_posture
from tests.real.virtual.standing import stand


def test_it_hangs_in_the_hand_and_stands_when_let_go():
  body = Body(hidden=Hidden.draw(7))
  stand(body, 0.3)
  assert body.truth().held and body.truth().position[2] > 0.28
  body.hold(False)
  stand(body, 2.5)
  truth = body.truth()
  assert not truth.held and not truth.touches_floor
  assert truth.position[2] == pytest.approx(standing_posture()[2], abs=0.006)
  assert truth.rotation[2, 2] > 0.999


def test_a_person_turns_the_robot_in_the_hand():
  body = Body()
  stand(body, 0.2)
  for yaw in np.linspace(0.0, 0.6, 40):
    body.turn(yaw)
    body.advance(body.time + 0.025)
  body.advance(body.time + 0.3)
  assert body.truth().yaw == pytest.approx(0.6, abs=0.02) and body.truth().held


def test_it_falls_without_torque_and_that_is_noticed():
  body = Body()
  body.hold(False)
  body.advance(3.0)
  assert body.truth().rotation[2, 2] < 0.6 or body.truth().position[2] < 0.15
  assert body.truth().touches_floor
  body.place(0.5, -0.3, 1.0)
  truth = body.truth()
  assert not truth.touches_floor and truth.held
  np.testing.assert_allclose(truth.position, [0.5, -0.3, 0.3], atol=1e-9)
  assert truth.yaw == pytest.approx(1.0)


def test_mass_is_the_link_tables_and_the_payload():
  links = sum(link.mass for link in constants.read_links())
  for hidden in (Hidden.none(), Hidden.draw(3)):
    model = Body(hidden=hidden).model
    assert sum(model.body_mass) == pytest.approx(links + hidden.payload, rel=1e-9)


def test_the_physics_is_not_the_simulations():
  model = Body(hidden=Hidden.draw(3)).model
  assert model.nu == 0  # torques come from voltages
  assert model.opt.timestep == STEP == 0.001
  joint = model.joint("op3/l_knee")
  assert joint.damping[0] < 0.1  # back-EMF is not in the joint
  foot = model.body("op3/l_ank_roll_link").geomadr[0]
  assert model.geom_friction[foot, 0] == pytest.approx(Hidden.draw(3).foot_friction)


def test_the_imu_feels_gravity_and_turning():
  body = Body()
  stand(body, 0.5)
  np.testing.assert_allclose(body.imu[3:], [0, 0, 9.81], atol=0.15)
  body.data.qvel[body._root_dof + 5] = 1.0  # turn about z, as the hand would
  body.data.eq_active[body._weld] = 0
  body.advance(body.time + 0.012)
  assert body.imu[2] > 0.5


def test_a_push_moves_it():
  body = Body()
  stand(body, 0.2)
  body.hold(False)
  stand(body, 2.5)
  before = body.truth().position
  body.push = np.array([0.0, 12.0, 0.0])
  stand(body, 0.2)
  assert body.truth().position[1] - before[1] > 0.003


def test_poses_of_the_past_are_kept():
  body = Body()
  body.advance(0.2)
  body.place(1.0, 0.0, 0.0)
  body.advance(0.4)
  assert body.pose_at(0.1)[body._root] == pytest.approx(0.0, abs=0.01)
  assert body.pose_at(0.39)[body._root] == pytest.approx(1.0, abs=0.01)


def test_the_ball_lies_where_it_was_put():
  body = Body(ball=True)
  body.place_ball(0.8, 0.2)
  body.advance(0.5)
  np.testing.assert_allclose(body.truth().ball, [0.8, 0.2, 0.12], atol=0.005)
  with pytest.raises(ValueError, match="ball=True"):
    Body().place_ball(0.0, 0.0)


def test_things_can_be_added_and_touching_them_is_noticed():
  def furnish(spec):
    spec.worldbody.add_geom(
      type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.5, 0.5], pos=[0.12, 0, 0.5]
    )

  body = Body(furnish=furnish)
  stand(body, 0.1)
  body.data.eq_active[body._weld] = 0
  body.push = np.array([40.0, 0.0, 0.0])
  stand(body, 0.15)
  assert body.truth().touches_room and not body.truth().touches_floor


def test_an_unknown_world_is_refused():
  with pytest.raises(ValueError, match="'moon'"):
    Body(world="moon")
