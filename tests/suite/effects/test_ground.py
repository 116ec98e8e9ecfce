"""Effects of the ground on things that roll and slide, against analytic expectations."""

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect, EffectStack

_GROUND = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 .1" friction=".5 .005 .0001"/>
    <body name="ball" pos="0 0 {height}">
      <freejoint/>
      <geom name="object" {geom} mass="1" friction=".5 .005 .0001"/>
    </body>
  </worldbody>
</mujoco>"""
_BALL = 'type="sphere" size=".1"'
_BOX = 'type="box" size=".1 .1 .05"'


def _roll(geom, height, effects, *, speed=0.0, count=600):
  model = mujoco.MjModel.from_xml_string(_GROUND.format(geom=geom, height=height))
  EffectStack(effects).bind(model)
  data = mujoco.MjData(model)
  data.qvel[0] = speed
  if geom == _BALL:
    data.qvel[4] = speed / 0.1
  for _ in range(100):
    mujoco.mj_step(model, data)
  before = data.qvel[0]
  for _ in range(count):
    mujoco.mj_step(model, data)
  return (data.qvel[0] - before) / (count * 0.001)


def test_floor_slope_rolls_a_ball_at_five_sevenths():
  # Turned about y by a: the floor falls towards +x.
  slope = _roll(_BALL, 0.1, [Effect("floor_slope", None, {"y": 0.05})])
  assert slope == pytest.approx(5 / 7 * 9.81 * np.sin(0.05) * np.cos(0.05), rel=0.01)
  assert abs(_roll(_BALL, 0.1, [])) < 1e-6


def test_floor_friction_scales_the_deceleration():
  for target in ("floor", None):
    effect = Effect("floor_friction", target, {"scale": 0.6})
    slide = _roll(_BOX, 0.05, [effect], speed=3.0, count=300)
    assert slide == pytest.approx(-0.6 * 0.5 * 9.81, rel=0.02)


def test_a_slippery_floor_leaves_a_ball_its_rolling_friction():
  # The ball has priority, as the one of ball pushing.
  ball = f'{_BALL} condim="6" priority="1"'
  for effects in ([], [Effect("floor_friction", "floor", {"scale": 0.6})]):
    model = mujoco.MjModel.from_xml_string(
      _GROUND.format(geom=ball, height=0.1).replace("0001", "004")
    )
    EffectStack(effects).bind(model)
    data = mujoco.MjData(model)
    data.qvel[0], data.qvel[4] = 1.5, 15.0
    mujoco.mj_step(model, data, 600)
    slowed = (data.qvel[0] - 1.5) / 0.6
    assert slowed == pytest.approx(-5 / 7 * 0.004 * 9.81 / 0.1, rel=0.1)
  assert (model.geom("floor").priority, model.geom("object").priority) == (1, 2)


def test_rolling_resistance():
  # m a = -F, I w' = F r - c N, I = 2/5 m r^2: a = -(5/7) c g / r.
  effect = Effect("rolling_resistance", "object", {"coefficient": 0.004})
  assert _roll(_BALL, 0.1, [effect], speed=1.5) == pytest.approx(
    -5 / 7 * 0.004 * 9.81 / 0.1, rel=0.04
  )
  assert abs(_roll(_BALL, 0.1, [], speed=1.5)) < 1e-3
