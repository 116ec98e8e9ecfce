"""Recordings of a virtual robot: what turning on a floor shows of its slope, and what repeats."""

import contextlib

import numpy as np
import pytest

from nerf2real.evaluation.loop import naming, story
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


@pytest.mark.parametrize("given", [False, True])
def test_a_loop_with_a_policy_records_the_reference_that_it_uses(tmp_path, monkeypatch, given):
  """With --reference it had recorded one more, unused, and the stand with the noise of none."""
  reference = tmp_path / "before"
  reference.mkdir()
  for name in motions.TRAIN:
    (reference / f"{name}.mcap").write_bytes(b"a log")
  made = {}

  @contextlib.contextmanager
  def virtual_robot(seed, altered=(), *, films=False, age=0.0, noise=0):
    yield noise, altered

  def record_stand(folder, link, robot, *, seconds, lens):
    made[folder.name] = (link, robot)

  monkeypatch.setattr(machines, "virtual_robot", virtual_robot)
  monkeypatch.setattr(recording, "record_stand", record_stand)
  monkeypatch.setattr(recording, "record_floor", lambda folder, link, robot: None)
  out = tmp_path / "out"
  settings = LoopSettings(policy="walker", out=out, reference=reference if given else None)
  hidden = undeclared.parse_all(["command_delay:0.045"])
  found = story._record(settings, hidden, lambda line: None)
  if given:
    assert found == reference
    assert made == {"stand": (machines.noise_beside(reference), hidden)}
  else:
    assert found == out / "reference"
    assert made == {"stand": (0, hidden), "reference": (1, ())}


def test_another_recording_of_the_same_robot_differs_and_the_same_one_repeats():
  def recorded(noise):
    actions = motions.motion("sweep", 40)
    with machines.virtual_robot(1, noise=noise) as (connection, robot):
      return recording.play_actions(connection, actions, robot, held=True)

  first, again, other = (recorded(noise) for noise in (0, 0, 1))
  assert np.array_equal(first, again)
  differing = np.abs(first - other)
  assert 0 < differing.max() < 0.01 and np.median(differing) < 0.002  # a count is 1.5 mrad
