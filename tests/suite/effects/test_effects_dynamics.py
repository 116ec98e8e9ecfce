"""Each effect on motion against an analytic or independently integrated expectation."""

import mujoco
import numpy as np
import pytest
import scipy.integrate

from nerf2real.suite.effects import Effect, EffectStack
from tests.suite.effects.rolling import INERTIA, STEP, hinge, run


def _times(count):
  return STEP * np.arange(1, count + 1)


def test_coulomb_friction_takes_4_f_over_k_a_cycle():
  model = hinge(joint='stiffness="4"')
  period = 2 * np.pi * np.sqrt(INERTIA / 4)
  q, _, _, _ = run(
    model, [Effect("coulomb_friction", "hinge", {"torque": 0.05})], np.zeros(1300), position=1.0
  )
  peaks = [q[round(n * period / STEP) - 1] for n in (1, 2, 3, 4)]
  np.testing.assert_allclose(peaks, 1 - 4 * 0.05 / 4 * np.arange(1, 5), atol=4e-3)


def test_coulomb_friction_holds_at_rest():
  effect = [Effect("coulomb_friction", "hinge", {"torque": 0.05})]
  q, _, _, _ = run(hinge(), effect, np.full(1000, 0.045))
  assert abs(q[-1]) < 1e-4
  q, _, _, _ = run(hinge(), effect, np.full(1000, 0.055))
  # The excess of 0.005 N m accelerates: 0.5 * 0.005 / 0.01 * t^2 after 1 s.
  assert q[-1] == pytest.approx(0.25, rel=0.01)


def test_viscous_friction_decays_exponentially():
  effect = Effect("viscous_friction", "hinge", {"coefficient": 0.02})
  _, v, _, _ = run(hinge(), [effect], np.zeros(500), velocity=3.0)
  np.testing.assert_allclose(v, 3 * np.exp(-0.02 / INERTIA * _times(500)), rtol=2e-3)


def test_quadratic_drag():
  # dv/dt = -(c / I) v^2: v = v0 / (1 + c v0 t / I), in both directions.
  effect = Effect("quadratic_drag", "hinge", {"coefficient": 0.01})
  for sign in (1, -1):
    _, v, _, _ = run(hinge(), [effect], np.zeros(500), velocity=3.0 * sign)
    np.testing.assert_allclose(v, sign * 3 / (1 + 0.01 * 3 / INERTIA * _times(500)), rtol=4e-3)


def test_stribeck_friction_breaks_away_and_falls():
  effects = [
    Effect("coulomb_friction", "hinge", {"torque": 0.05}),
    Effect("stribeck_friction", "hinge", {"breakaway": 0.03, "velocity": 0.2}),
  ]
  q, _, _, _ = run(hinge(), effects, np.full(500, 0.075))
  assert abs(q[-1]) < 1e-4  # below 0.08 N m it stays
  q, _, _, _ = run(hinge(), effects, np.full(500, 0.085))
  assert q[-1] > 0.1  # above, it goes

  def decelerate(_, v):
    return -(0.05 + 0.03 * np.exp(-((v / 0.2) ** 2))) / INERTIA

  _, v, _, _ = run(hinge(), effects, np.zeros(150), velocity=1.0)
  times = _times(150)
  expected = scipy.integrate.solve_ivp(decelerate, (0, 0.15), [1.0], t_eval=times, rtol=1e-9).y[0]
  np.testing.assert_allclose(v, expected, atol=8e-3)


def test_load_friction_takes_its_share_of_the_torque():
  effect = Effect("load_friction", "hinge", {"coefficient": 0.3})
  for torque in (0.1, -0.2):
    _, v, _, _ = run(hinge(), [effect], np.full(300, torque))
    acceleration = (v[-1] - v[100]) / (199 * STEP)
    assert acceleration == pytest.approx(0.7 * torque / INERTIA, rel=1e-3)


def test_load_friction_may_grow_with_the_square_and_fall_with_speed():
  shape = {"coefficient": 0.1, "quadratic": 2.0, "rest": 0.5, "velocity": 0.5}
  for torque in (0.1, -0.2):
    _, v, _, _ = run(hinge(), [Effect("load_friction", "hinge", shape)], np.full(300, torque))

    def accelerate(_, v, torque=torque):
      friction = (0.1 + 2.0 * abs(torque)) * (1 + 0.5 * np.exp(-((v / 0.5) ** 2)))
      return torque * (1 - friction) / INERTIA

    times = _times(300)
    want = scipy.integrate.solve_ivp(accelerate, (0, 0.3), [0.0], t_eval=times, rtol=1e-9).y[0]
    # In the first step there is no torque yet that rubs.
    np.testing.assert_allclose(v, want, atol=0.02 * abs(want[-1]))


def test_asymmetric_friction():
  effect = [Effect("asymmetric_friction", "hinge", {"positive": 0.06, "negative": 0.02})]
  for velocity, friction in ((2.0, 0.06), (-2.0, 0.02)):
    _, v, _, _ = run(hinge(), effect, np.zeros(250), velocity=velocity)
    slope = (v[200] - v[0]) / (200 * STEP)
    assert slope == pytest.approx(-np.sign(velocity) * friction / INERTIA, rel=0.01)
  for torque, moves in ((0.055, False), (0.065, True), (-0.018, False), (-0.025, True)):
    q, _, _, _ = run(hinge(), effect, np.full(600, torque))
    assert (abs(q[-1]) > 0.02) == moves


def test_command_delay_shifts_exactly():
  controls = np.random.default_rng(0).normal(size=400).cumsum() * 0.01
  q, _, _, _ = run(hinge("position"), [Effect("command_delay", None, {"delay": 0.012})], controls)
  late = np.concatenate([np.full(12, controls[0]), controls[:-12]])
  expected, _, _, _ = run(hinge("position"), [], late)
  np.testing.assert_array_equal(q, expected)


def test_command_delay_of_a_fraction_is_the_mean_over_the_step():
  stack = EffectStack([Effect("command_delay", "hinge", {"delay": 0.0025})]).bind(hinge())
  data = mujoco.MjData(stack.binding.model)
  seen = []
  for ctrl in (0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0):
    stack.before_step(data, np.array([ctrl]))
    seen.append(data.ctrl[0])
  assert seen == [0, 0, 0, 0, 0, 0.5, 1, 1]


def test_encoder_offset_moves_the_servo_and_the_reading():
  effect = Effect("encoder_offset", "hinge", {"offset": 0.1})
  q, _, stack, data = run(hinge("position", joint='damping="0.3"'), [effect], np.full(3000, 0.5))
  assert q[-1] == pytest.approx(0.4, abs=1e-6)
  assert stack.observe("joint_positions", data.qpos, data.time)[0] == pytest.approx(0.5, abs=1e-6)
  assert stack.observe("joint_velocities", data.qvel, data.time) is data.qvel


def test_motor_gain():
  _, v, _, _ = run(hinge(), [Effect("motor_gain", "drive", {"gain": 0.7})], np.full(100, 0.1))
  assert v[-1] == pytest.approx(0.7 * 0.1 / INERTIA * 0.1, rel=1e-6)
  # A position servo is softer: gravity torque m g l sin(q) against 0.5 * 5 N m/rad.
  model = hinge("position", joint='damping="0.3"', option="", com="0.05 0 0")
  q, _, _, _ = run(model, [Effect("motor_gain", None, {"gain": 0.5})], np.zeros(4000))
  assert 2.5 * abs(q[-1]) == pytest.approx(9.81 * 0.05 * np.cos(q[-1]), rel=1e-4)
  # Where back-EMF follows, a weak motor turns as fast without load as a strong one.
  weak = {"gain": 0.2, "scales_damping": 1.0}
  model = hinge(joint='damping="0.3"')
  _, v, _, _ = run(model, [Effect("motor_gain", "drive", weak)], np.full(4000, 0.1))
  assert v[-1] == pytest.approx(0.1 / 0.3, rel=1e-3)


def test_torque_limit():
  _, v, _, data = run(hinge(), [Effect("torque_limit", None, {"limit": 0.03})], np.full(100, 0.1))
  assert data.actuator_force[0] == 0.03
  assert v[-1] == pytest.approx(0.03 / INERTIA * 0.1, rel=1e-6)


def test_thermal_derating():
  # Blocked by dry friction: heating * torque^2 * tau * (1 - exp(-t / tau)) with the torque itself
  # falling; integrated independently.
  def heat(_, rise):
    torque = 0.5 * (1 - 0.05 * rise)
    return 20 * torque**2 - rise / 0.5

  effect = Effect(
    "thermal_derating", None, {"heating": 20.0, "time_constant": 0.5, "derating": 0.05}
  )
  _, _, stack, data = run(hinge(joint='frictionloss="5"'), [effect], np.full(1000, 0.5))
  rise = scipy.integrate.solve_ivp(heat, (0, 1.0), [0.0], rtol=1e-9).y[0, -1]
  assert stack.operator("thermal_derating").temperature_rise[0] == pytest.approx(rise, rel=5e-3)
  assert data.actuator_force[0] == pytest.approx(0.5 * (1 - 0.05 * rise), rel=5e-3)
  stack.reset()
  assert stack.operator("thermal_derating").temperature_rise[0] == 0


def test_supply_sag_settles_where_load_and_strength_agree():
  # s = 1 - 0.1 * s * 2 -> s = 1 / 1.2; plus a fade of 0.05 per second.
  effect = Effect("supply_sag", None, {"droop": 0.1})
  _, _, _, data = run(hinge(joint='frictionloss="9"'), [effect], np.full(200, 2.0))
  assert data.actuator_force[0] == pytest.approx(2 / 1.2, rel=1e-3)
  effect = Effect("supply_sag", None, {"fade": 0.5})
  _, _, _, data = run(hinge(joint='frictionloss="9"'), [effect], np.full(201, 2.0))
  assert data.actuator_force[0] == pytest.approx(2 * (1 - 0.5 * 0.2), rel=1e-6)


@pytest.mark.parametrize(("pulsed", "strength"), [(0.0, 1 / 1.08), (1.0, 1 / 1.2)])
def test_a_source_with_a_resistance_feeds_a_bridge(pulsed, strength):
  # Stalled at a duty of 2/5: in the mean 0.4 * 2 s are drawn, 2 s while the bridge is on.
  model = hinge(joint='frictionloss="9"')
  model.actuator_forcelimited[:], model.actuator_forcerange[:] = 1, (-5, 5)
  values = {"droop": 0.1, "back_emf": 1.0, "pulsed": pulsed}
  _, _, _, data = run(model, [Effect("supply_sag", None, values)], np.full(200, 2.0))
  assert data.actuator_force[0] == pytest.approx(2 * strength, rel=1e-3)


def test_limits_recover_with_the_supply():
  model = hinge()
  model.actuator_forcelimited[:], model.actuator_forcerange[:] = 1, (-5, 5)
  values = {"droop": 0.1, "back_emf": 1.0, "pulsed": 1.0, "scales_limit": 1.0}
  stack = EffectStack([Effect("supply_sag", None, values)]).bind(model)
  data = mujoco.MjData(model)
  limits = []
  for force in (2.0, 0.0):  # of the last step; without load the supply is whole again
    data.actuator_force[:] = force
    stack.before_step(data, np.zeros(1))
    limits.append(model.actuator_forcerange[0, 1])
  assert limits[0] < 4.5 and limits[1] == 5.0


def test_spring_beside_a_spring():
  model = hinge(joint='damping="0.2" stiffness="1" springref="28.64788975654116"')  # 0.5 rad
  effect = Effect("spring", "hinge", {"stiffness": 3.0, "reference": -0.1})
  q, _, _, _ = run(model, [effect], np.full(3000, 0.2))
  # 1 (0.5 - q) + 3 (-0.1 - q) + 0.2 = 0.
  assert q[-1] == pytest.approx(0.1, abs=1e-6)


def test_cogging():
  def swing(_, state):
    return state[1], 0.05 * np.sin(8 * state[0] + 0.5) / INERTIA

  effect = Effect("cogging", "hinge", {"amplitude": 0.05, "periods": 8.0, "phase": 0.5})
  q, _, _, _ = run(hinge(), [effect], np.zeros(500), velocity=2.0)
  result = scipy.integrate.solve_ivp(
    swing, (0, 0.5), [0.0, 2.0], t_eval=_times(500), rtol=1e-9, atol=1e-11
  )
  np.testing.assert_allclose(q, result.y[0], atol=3e-3)


def test_gravity_tilt_and_payload_on_a_pendulum():
  # Gravity turned about y by 0.2: the pendulum's rest turns with it.
  model = hinge(joint='damping="0.2"', option="", com="0 0 -0.1")
  q, _, _, _ = run(model, [Effect("gravity_tilt", None, {"y": 0.2})], np.zeros(3000))
  assert q[-1] == pytest.approx(0.2, abs=1e-6)
  # Half a kilogram at (0.1, 0, 0) on 1 kg at (0, 0, -0.1): rest at atan(0.5).
  for target in ("link", "hinge"):
    model = hinge(joint='damping="0.2"', option="", com="0 0 -0.1")
    q, _, _, _ = run(model, [Effect("payload", target, {"mass": 0.5, "x": 0.1})], np.zeros(4000))
    assert q[-1] == pytest.approx(np.arctan(0.5), abs=1e-6)
    assert model.dof_M0[0] == pytest.approx(INERTIA + 0.01 + 0.005)


def test_parameter_error():
  model = hinge(joint='damping="0.1" armature="0.02" frictionloss="0.3"', com="0 0 -0.1")
  nominal = {name: getattr(model, name).copy() for name in ("dof_damping", "dof_frictionloss")}
  factors = {"damping": 1.1, "armature": 0.5, "friction": 0.8, "gain": 1.2, "mass": 2.0}
  stack = EffectStack([Effect("parameter_error", "hinge", factors)]).bind(model)
  assert model.dof_damping[0] == 1.1 * nominal["dof_damping"][0]
  assert model.dof_frictionloss[0] == 0.8 * nominal["dof_frictionloss"][0]
  assert model.actuator_gainprm[0, 0] == 1.2
  # Inertia about the joint: 2 * (0.01 + 1 * 0.1^2) + 0.5 * 0.02.
  assert model.dof_M0[0] == pytest.approx(0.05)
  stack.unbind()
  assert model.dof_M0[0] == pytest.approx(0.04)


def test_residual_force_is_the_product_of_features_and_weights():
  weights = np.random.default_rng(0).normal(size=(4, 3)) * 0.02
  grid = {
    "num_positions": 4,
    "num_velocities": 3,
    "position_low": -1.0,
    "position_high": 1.0,
    "velocity_low": -2.0,
    "velocity_high": 2.0,
  }

  def bumps(x, low, high, count):
    centres = np.linspace(low, high, count)
    spacing = centres[1] - centres[0]
    value = np.exp(-0.5 * ((np.clip(x, low, high) - centres) / spacing) ** 2)
    return value / value.sum()

  def swing(_, state):
    force = bumps(state[0], -1, 1, 4) @ weights @ bumps(state[1], -2, 2, 3)
    return state[1], force / INERTIA

  effect = Effect("residual_force", "hinge", {"weights": weights.ravel().tolist(), **grid})
  q, _, _, _ = run(hinge(), [effect], np.zeros(500), velocity=1.0)
  result = scipy.integrate.solve_ivp(swing, (0, 0.5), [0.0, 1.0], t_eval=_times(500), rtol=1e-9)
  np.testing.assert_allclose(q, result.y[0], atol=2e-3)


# Backlash: motor inertia 0.004, damping and dry friction 0.02 on the motor's side, link 0.006.
_GAP = 0.04
_TEETH = {"stiffness": 3000.0, "damping": 3.0}


def _geared():
  return hinge(
    "position", joint='armature="0.004" damping="0.15" frictionloss="0.02"', inertia=0.006
  )


def _two_masses(controls, *, encoder_on_motor, friction_on_link):
  """Motor and link joined by a stiff, damped spring with play; explicit, 20 steps a millisecond."""
  step, stiffness, damping = STEP / 20, _TEETH["stiffness"], _TEETH["damping"]
  motor = link = motor_speed = link_speed = 0.0
  result = []
  for ctrl in controls:
    for _ in range(20):
      twist = motor - link
      over = twist - np.clip(twist, -_GAP / 2, _GAP / 2)
      shaft = stiffness * over + damping * (motor_speed - link_speed) * (over != 0)
      if shaft * over < 0:
        shaft = 0.0
      drive = 5 * (ctrl - (motor if encoder_on_motor else link)) - 0.15 * motor_speed
      free = motor_speed + step * (drive - shaft) / 0.004
      slowed = step * (1 - friction_on_link) * 0.02 / 0.004
      motor_speed = np.sign(free) * max(0.0, abs(free) - slowed)
      free = link_speed + step * shaft / 0.006
      link_speed = np.sign(free) * max(0.0, abs(free) - step * friction_on_link * 0.02 / 0.006)
      motor, link = motor + step * motor_speed, link + step * link_speed
    result.append(link)
  return np.array(result)


def test_backlash_hysteresis_is_as_wide_as_the_gap():
  # Slow triangle, encoder on the motor: the link follows the motor with the play between them.
  ramp = np.linspace(0, 0.3, 1000)
  cycle = np.concatenate([ramp, ramp[::-1], -ramp, -ramp[::-1]])
  effect = Effect(
    "backlash", "hinge", {"gap": _GAP, "encoder_on_motor": 1.0, "friction_on_link": 1.0}
  )
  q, _, _, _ = run(_geared(), [effect], np.tile(cycle, 2))
  second = q[4000:]
  nominal, _, _, _ = run(_geared(), [], np.tile(cycle, 2))
  second_nominal = nominal[4000:]
  # On the way up (400 to 600) and down (1400 to 1600, the same commands in reverse).
  width = second[1399:1599][::-1] - second[400:600]
  width_nominal = second_nominal[1399:1599][::-1] - second_nominal[400:600]
  assert (width - width_nominal).mean() == pytest.approx(_GAP, abs=1e-3)


@pytest.mark.parametrize("friction_on_link", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("encoder_on_motor", [0.0, 1.0])
def test_backlash_against_two_masses(encoder_on_motor, friction_on_link):
  controls = 0.4 * np.sin(2 * np.pi * 1.5 * _times(1000))
  sides = {"encoder_on_motor": encoder_on_motor, "friction_on_link": friction_on_link}
  effect = Effect("backlash", "hinge", {"gap": _GAP, **sides, **_TEETH})
  q, _, stack, _ = run(_geared(), [effect], controls)
  expected = _two_masses(controls, **sides)
  nominal, _, _, _ = run(_geared(), [], controls)
  # The first cycle differs: these gears start in contact, the two masses in the middle of the gap.
  error, size = np.std((q - expected)[300:]), np.std((nominal - expected)[300:])
  assert error < min(0.05 * _GAP, 0.25 * size), (error, size)
  wound = np.abs(stack.operator("backlash").offset).max() - _GAP / 2
  assert 0 < wound < 2.0 / _TEETH["stiffness"]  # by the largest torque
