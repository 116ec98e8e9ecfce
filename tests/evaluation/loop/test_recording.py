"""What a robot that is turned on a floor shows of its slope."""

import numpy as np
import pytest

from nerf2real.evaluation.loop import naming
from nerf2real.evaluation.loop.robot import machines, recording
from nerf2real.real.virtual import undeclared


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.0, 0.0436])
def test_a_slope_is_named_from_turning_on_it_and_none_where_there_is_none(tmp_path, slope):
  altered = undeclared.parse_all([f"floor_slope:0,{slope}"])
  with machines.virtual_robot(1, altered) as (connection, robot):
    recording.record_floor(tmp_path, connection, robot)
  effects = naming._floor(tmp_path / "floor.mcap").effects
  if slope == 0:
    assert effects == []
    return
  (found,) = effects
  assert found.kind == "floor_slope"
  low, high = found.intervals["y"]
  assert low <= slope <= high and high - low < 0.06
  assert np.abs(found.parameters["x"]) < 0.02
