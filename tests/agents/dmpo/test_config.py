"""Settings: the paper's table, round trips, refusals."""

import dataclasses
import inspect
import json

import pytest

from nerf2real.agents.dmpo import config, presets
from nerf2real.core.serialization import from_plain, to_plain

# Byravan et al. 2022, appendix, table of DMPO hyperparameters, in its order.
TABLE = {
  "policy_learning_rate": 1e-4,
  "critic_learning_rate": 1e-4,
  "dual_learning_rate": 1e-2,
  "trajectory_length": 48,
  "batch_size": 32,
  "steps_per_update": 8,
  "discount": 0.99,
  "init_log_temperature": 10,
  "init_log_alpha_mean": 10,
  "init_log_alpha_stddev": 1000,
  "epsilon": 0.1,
  "epsilon_mean": 0.0025,
  "epsilon_stddev": 1e-6,
  "epsilon_action_penalty": 0.001,
  "per_dimension_kl": True,
  "action_penalization": True,
  "n_step": 5,
  "target_actor_period": 25,
  "target_critic_period": 100,
  "network.vmin": -150,
  "network.vmax": 150,
}


@pytest.mark.parametrize("name", TABLE)
def test_the_paper_s_table_is_the_default(name):
  value = presets.preset("paper")
  for part in name.split("."):
    value = getattr(value, part)
  assert value == TABLE[name]


@pytest.mark.parametrize("name", presets.PRESETS)
def test_settings_survive_json(name):
  settings = presets.preset(name)
  assert from_plain(json.loads(json.dumps(to_plain(settings))), config.DmpoConfig) == settings


@pytest.mark.parametrize(
  "cls", [config.DmpoConfig, config.NetworkConfig, config.AugmentationConfig]
)
def test_every_field_is_documented(cls):
  lines = inspect.getsource(cls).splitlines()
  for field in dataclasses.fields(cls):
    at = next(i for i, line in enumerate(lines) if line.strip().startswith(f"{field.name}:"))
    assert lines[at + 1].strip().startswith('"""'), field.name


def test_overrides_reach_inside_and_unknown_names_are_refused():
  changed = config.override(config.DmpoConfig(), {"network.vmax": 7.0, "batch_size": 4})
  assert (changed.network.vmax, changed.batch_size) == (7.0, 4)
  with pytest.raises(ValueError, match="Unknown setting"):
    config.override(config.DmpoConfig(), {"network.depth": 7.0})
  with pytest.raises(ValueError, match="Unknown preset"):
    presets.preset("big")
  with pytest.raises(ValueError, match="vmin must lie below"):
    config.override(config.DmpoConfig(), {"network.vmax": -200.0})
  with pytest.raises(ValueError, match="frozen_memory keeps the LSTM behind a frozen encoder"):
    config.override(config.DmpoConfig(), {"frozen_memory": True})
  for name, value, message in (
    ("batch_size", 1.5, "expected int, found 1.5"),
    ("n_step", "x", "expected int, found 'x'"),
    ("network.policy_layers", [8, "a"], "expected int, found 'a'"),
    ("network", 5, "DmpoConfig"),
    ("batch_size.x", 1, "Unknown setting 'batch_size.x'"),
    ("target_actor_period", 0, "target_actor_period must be 1 or more, found 0"),
    ("num_samples", 0, "num_samples must be 1 or more, found 0"),
    ("discount", 99, "discount must be 0 to 1, found 99"),
    ("network.num_atoms", 1, "num_atoms must be 2 or more, found 1"),
    ("network.policy_layers", [], "network.policy_layers must have a layer"),
  ):
    with pytest.raises(ValueError, match=message) as found:
      config.override(config.DmpoConfig(), {name: value})
    assert "\n" not in str(found.value)
  with pytest.raises(ValueError, match="another version"):
    from_plain({"colour": 1}, config.DmpoConfig)
