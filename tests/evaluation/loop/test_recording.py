"""Recordings of a virtual robot: what turning on a floor shows of its slope, and what repeats."""

import numpy as np
import pytest

from nerf2real.evaluation.loop import naming
from nerf2real.evaluation.loop.joint_space import closing
from nerf2real.evaluation.loop.robot import machines, motions, recording
from nerf2real.evaluation.loop.settings import LoopSettings
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


def test_a_recording_beside_a_reference_has_a_noise_of_its_own(tmp_path, monkeypatch):
  """The joint-position loop had recorded the robot with what is hidden, to the bit, else."""
  reference = tmp_path / "reference"
  reference.mkdir()
  (reference / f"{motions.TRAIN[0]}.mcap").write_bytes(b"a log")
  assert machines.noise_beside(None) == 0
  noise = machines.noise_beside(reference)
  assert noise not in (0, 1) and machines.noise_beside(reference) == noise
  (reference / f"{motions.TRAIN[0]}.mcap").write_bytes(b"another")
  assert machines.noise_beside(reference) != noise

  class Recorded(Exception):
    pass

  def virtual_robot(seed, altered, *, noise=0):
    raise Recorded(noise)

  monkeypatch.setattr(machines, "virtual_robot", virtual_robot)
  for name in motions.TRAIN[1:]:
    (reference / f"{name}.mcap").touch()
  for given, expected in ((None, 0), (reference, machines.noise_beside(reference))):
    settings = LoopSettings(out=tmp_path / str(expected), reference=given)
    with pytest.raises(Recorded, match=str(expected)):
      closing.close_loop(settings)


def test_another_recording_of_the_same_robot_differs_and_the_same_one_repeats():
  def recorded(noise):
    actions = motions.motion("sweep", 40)
    with machines.virtual_robot(1, noise=noise) as (connection, robot):
      return recording.play_actions(connection, actions, robot, held=True)

  first, again, other = (recorded(noise) for noise in (0, 0, 1))
  assert np.array_equal(first, again)
  differing = np.abs(first - other)
  assert 0 < differing.max() < 0.01 and np.median(differing) < 0.002  # a count is 1.5 mrad
