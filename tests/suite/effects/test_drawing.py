"""Effects drawn from joint samples and from intervals."""

import json

import numpy as np
import pytest

from nerf2real.suite.effects import Effect, read_effects, write_effects
from nerf2real.suite.effects.drawing import as_gravity, draw_effects

COUNT = 64


@pytest.fixture
def effects():
  """Two effects whose values go together, and one with an interval alone."""
  random = np.random.default_rng(0)
  torque = random.uniform(0.1, 0.3, COUNT)
  return [
    Effect(
      "coulomb_friction",
      "elbow",
      {"torque": 0.2},
      {"torque": (0.1, 0.3)},
      {"torque": torque.tolist()},
    ),
    Effect(
      "viscous_friction",
      "elbow",
      {"coefficient": 0.8},
      {"coefficient": (0.7, 0.9)},
      {"coefficient": (1.0 - torque).tolist()},
    ),
    Effect("command_delay", None, {"delay": 0.02}, {"delay": (0.01, 0.03)}),
  ]


@pytest.mark.parametrize("random", [np.random.default_rng(1), np.random.RandomState(1)])
def test_values_with_samples_are_of_one_draw(effects, random):
  drawn = [draw_effects(effects, random) for _ in range(300)]
  torque, coefficient, delay = (
    np.array([d[at].parameters[name] for d in drawn])
    for at, name in enumerate(("torque", "coefficient", "delay"))
  )
  np.testing.assert_allclose(torque + coefficient, 1.0)
  assert set(torque) <= set(effects[0].samples["torque"])
  assert len(set(torque)) > COUNT / 2
  assert 0.01 <= delay.min() < 0.012 < 0.028 < delay.max() <= 0.03
  assert abs(np.corrcoef(torque, delay)[0, 1]) < 0.3


def test_samples_are_read_as_they_were_written(effects, tmp_path):
  write_effects(tmp_path / "effects.json", effects)
  assert read_effects(tmp_path / "effects.json") == effects


def test_values_of_different_numbers_of_draws_are_refused(effects, tmp_path):
  path = tmp_path / "effects.json"
  write_effects(path, effects)
  items = json.loads(path.read_text())
  items[0]["parameters"]["torque"]["samples"].pop()
  path.write_text(json.dumps(items))
  with pytest.raises(ValueError, match="Found 63 samples of 'torque'.*64 of 'coefficient'"):
    read_effects(path)


@pytest.mark.parametrize("samples", [0.2, [0.2, -0.1], [0.2, "a"]])
def test_samples_that_are_no_possible_values_are_refused(samples, tmp_path):
  path = tmp_path / "effects.json"
  entry = {"value": 0.2, "low": 0.1, "high": 0.3, "unit": "N m", "samples": samples}
  item = {"kind": "coulomb_friction", "target": "elbow", "parameters": {"torque": entry}}
  path.write_text(json.dumps([item]))
  with pytest.raises(ValueError, match="torque"):
    read_effects(path)


def test_a_slope_turns_gravity_the_other_way_in_every_draw():
  slope = Effect("floor_slope", None, {"x": 0.1, "y": 0.0}, {"x": (0.05, 0.2)}, {"x": [0.1, 0.2]})
  tilt = as_gravity(slope)
  assert tilt.kind == "gravity_tilt"
  assert tilt.samples == {"x": [-0.1, -0.2]}
  assert tilt.intervals == {"x": (-0.2, -0.05)}
