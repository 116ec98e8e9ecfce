"""Duties that a servo's law makes of commands and readings."""

import numpy as np
import pytest

from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.model.kernel import INDEX, NAMES
from nerf2real.sysid.model.servo.duty import ASKED, Asked, asked_torque, duty_of
from tests.sysid.model.servo.test_law import plant_of


def test_a_weaker_motor_changes_no_duty():
  plant = plant_of()
  term = next(
    t
    for t in candidates.library(plant)
    if t.kind == "motor_gain" and dict(t.fixed)["scales_limit"] == 1.0
  )
  p = plant.declared.copy()
  before = duty_of(plant, p, 0)
  term.apply(plant, p, np.array([0.7]))
  np.testing.assert_allclose(duty_of(plant, p, 0), before)


@pytest.mark.parametrize("name", NAMES)
def test_what_a_law_asks_for_is_that_of_the_parameters_it_is_kept_by(name):
  plant = plant_of()
  before, p = asked_torque(plant, plant.declared, 0), plant.declared.copy()
  p[INDEX[name]] += 0.013
  differs = not np.array_equal(asked_torque(plant, p, 0), before)
  assert differs == (INDEX[name] in ASKED)


def test_what_is_kept_is_what_is_computed_afresh():
  plant = plant_of()
  asked, p = Asked(plant), plant.declared.copy()
  for delay in (0.0, 0.01, 0.02, 0.03, 0.04, 0.0, 0.04):  # more than are kept, and some again
    p[INDEX["command_delay"]] = delay
    for ahead in (0.0, 0.002):
      fresh = [asked_torque(plant, p, i, ahead=ahead) for i in range(len(plant.logs))]
      np.testing.assert_array_equal(asked.torque(p, ahead), np.concatenate(fresh))
