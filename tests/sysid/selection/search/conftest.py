"""What several files here explain."""

import pytest

from nerf2real.suite.effects import Effect
from tests.sysid.selection.search.explainers import KINDS, explainer_of


@pytest.fixture(scope="module")
def explainer():
  hidden = [
    Effect("coulomb_friction", "joint", {"torque": 0.3}),
    Effect("motor_gain", "joint", {"gain": 1.3, "scales_limit": 1.0}),
  ]
  return explainer_of(hidden, KINDS)
