"""Contacts that bend before they slide, against what Dahl's law says of them."""

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect, EffectStack
from tests.suite.effects.rolling import INERTIA, STEP, hinge, rollout, run


def _bending(reach=0.01, friction=0.05):
  return [
    Effect("coulomb_friction", "hinge", {"torque": friction}),
    Effect("presliding", "hinge", {"reach": reach}),
  ]


def test_contacts_bend_before_they_slide_as_dahl_has_it():
  # From rest a share s of the friction is met where -log(1 - s) of the reach is bent; taken away,
  # log(1 + s) of it comes back.
  damped = hinge(joint='damping="0.3"')
  controls = np.r_[np.full(2000, 0.025), np.zeros(2000)]
  q, _, _, _ = run(damped, _bending(), controls)
  assert q[1999] == pytest.approx(0.01 * np.log(2.0), rel=0.01)
  assert q[-1] == pytest.approx(0.01 * np.log(2.0 / 1.5), rel=0.02)
  controls = np.r_[np.full(500, 0.08), np.zeros(2500)]
  q, _, _, _ = run(damped, _bending(), controls)
  assert q.max() > 0.03  # slid
  assert q[-1] == pytest.approx(q.max() - 0.01 * np.log(2.0), abs=5e-4)


def test_contacts_that_bend_lose_what_they_slide():
  # From 1 to the next peak p a rigid friction f takes 2 f (1 + p). One that bends by r takes f r
  # less as it begins, and 2 f r less after the turn.
  model = hinge(joint='stiffness="4"')
  period = round(2 * np.pi * np.sqrt(INERTIA / 4) / STEP)
  for reach in (1e-5, 0.1):
    q, _, _, _ = run(model, _bending(reach), np.zeros(400), position=1.0)
    peak = q[period - 60 : period + 60].max()
    lost = 0.05 * (2 * (1 + peak) - 3 * reach)
    assert 0.5 * 4 * (1 - peak**2) == pytest.approx(lost, rel=0.02)


def test_contacts_that_bend_start_anew_with_an_episode():
  stack = EffectStack(_bending()).bind(hinge(joint='damping="0.3"'))
  paths = []
  for _ in range(2):
    stack.reset()
    data = mujoco.MjData(stack.binding.model)
    paths.append(rollout(stack, data, np.full((300, 1), 0.04))[0][:, 0])
  np.testing.assert_array_equal(*paths)
