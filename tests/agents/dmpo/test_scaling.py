"""Scaled observations: what is measured, that folding changes no action, that training sees it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerf2real.agents.dmpo import config, learning, networks, presets, scaling, training_state
from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.dmpo.replay.ring import Replay, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.core.serialization import to_plain

LAYOUT = Layout("camera", (6, 8, 3), ("a", "b"), (3, 2), ("privileged/p",), (4,), 2)
CONFIG = config.override(
  presets.preset("op3_small"),
  {
    "network.policy_layers": (12, 9),
    "network.critic_layers": (8,),
    "network.image_channels": (3,),
    "network.image_features": 5,
    "network.lstm_size": 4,
    "network.init_stddev": 0.1,
    "trajectory_length": 6,
    "num_samples": 4,
    "first_action": "zero",
  },
)
SPREAD = np.array([1.0, 10.0, 0.01, 5.0, 1e-9])
CENTRE = np.array([0.0, 100.0, -3.0, 2.0, 7.0])


def _rows(count=4000, seed=0):
  rng = np.random.default_rng(seed)
  state = CENTRE + SPREAD * rng.normal(size=(count, 5))
  return {"state": state, "privileged": rng.normal(size=(count, 4)) * 0.03}


def _noisy(params, seed=1):
  rng = np.random.default_rng(seed)
  return jax.tree.map(lambda x: x + 0.2 * rng.normal(size=x.shape).astype(np.float32), params)


@pytest.fixture(scope="module")
def functions():
  return learning.make_learning(CONFIG, LAYOUT)


@pytest.fixture
def state(functions):
  """A state with parameters away from their small first values, and the scaling measured."""
  fresh = jax.jit(functions.init)(jax.random.PRNGKey(0))
  fresh = fresh._replace(policy=_noisy(fresh.policy), target_policy=_noisy(fresh.policy, 2))
  scales = scaling.measure(_rows(), LAYOUT)
  return training_state.with_scaling(fresh, scales, keep_policy=False)


def _exported(state, folder):
  export.export_policy(
    folder,
    training_state.served_parameters(state),
    layout=LAYOUT,
    environment="test",
    settings=to_plain(CONFIG),
    info={},
  )
  return export.load_policy(folder).policy


def _target_action(state, image, row):
  """The training network's Gaussian for one observation, of the target policy."""
  initial = networks.LstmState(jnp.zeros((1, 4)), jnp.zeros((1, 4)))
  output = networks.unroll_policy(
    state.target_policy,
    CONFIG.network,
    state=scaling.apply(state.scaling, "state", row)[None, None],
    images=image[None, None] / 255.0,
    initial=initial,
  )
  return np.asarray(output.action.mean)[0, 0], np.asarray(output.action.stddev)[0, 0]


def test_a_policy_of_another_critic_s_observations_begins_unscaled(state, tmp_path):
  """Its scaling does not fit; the policy, which sees the same, acts as before and trains."""
  policy = _exported(state, tmp_path)
  other = dataclasses.replace(LAYOUT, privileged_sizes=(7,))
  learner = learning.make_learning(CONFIG, other)
  fresh = jax.jit(learner.init)(jax.random.PRNGKey(5))
  begun = training_state.with_policy(fresh, export.load_arrays(tmp_path))
  assert not scaling.is_measured(begun.scaling)
  rows = _rows() | {"privileged": np.random.default_rng(3).normal(size=(4000, 7))}
  measured = training_state.with_scaling(begun, scaling.measure(rows, other), keep_policy=True)
  image, row = np.full((6, 8, 3), 90, np.uint8), CENTRE.astype(np.float32)
  wanted = policy.step(image, row, policy.initial_state()).mean
  for found in (begun, measured):
    np.testing.assert_allclose(_target_action(found, image, row)[0], wanted, rtol=1e-3, atol=1e-3)
  assert measured.scaling["privileged"]["mean"].shape == (7,)


def test_columns_are_standardised_but_hardly_varying_ones_are_not_blown_up():
  rows = _rows()
  scales = scaling.measure(rows, LAYOUT)
  scaled = scaling.apply(scales, "state", rows["state"])
  np.testing.assert_allclose(scaled.mean(0), 0.0, atol=1e-2)
  np.testing.assert_allclose(scaled.std(0)[[1, 3]], 1.0, atol=1e-3)
  # The deviation of observation "a" is 5.8 in RMS: 0.01 counts as a tenth of that.
  rms = np.sqrt(np.mean(rows["state"][:, :3].std(0) ** 2))
  np.testing.assert_allclose(scales["state"]["stddev"][2], 0.1 * rms, rtol=1e-4)
  np.testing.assert_allclose(scales["privileged"]["stddev"], 0.03, rtol=0.05)
  constant = scaling.measure({"state": rows["state"] * 0, "privileged": rows["privileged"]}, LAYOUT)
  np.testing.assert_allclose(constant["state"]["stddev"], 1e-3)


def test_folding_and_unfolding_are_inverse(state):
  folded = scaling.fold(state.policy, state.scaling)
  back = scaling.unfold(folded, state.scaling)
  jax.tree.map(
    lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), back, state.policy
  )
  assert np.abs(folded["mlp"]["layer0"]["w"] - state.policy["mlp"]["layer0"]["w"]).max() > 0.1
  # The picture's rows come first and stay.
  np.testing.assert_array_equal(
    folded["mlp"]["layer0"]["w"][:-5], np.asarray(state.policy["mlp"]["layer0"]["w"])[:-5]
  )


def test_the_exported_policy_acts_as_the_training_network(state, tmp_path):
  policy = _exported(state, tmp_path)
  rng = np.random.default_rng(3)
  for row in _rows(5, seed=4)["state"].astype(np.float32):
    image = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    step = policy.step(image, row, policy.initial_state())
    mean, stddev = _target_action(state, image, row)
    np.testing.assert_allclose(step.mean, mean, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(step.stddev, stddev, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("with_scales", [True, False])
def test_training_begins_with_an_exported_policy_and_its_actions(
  state, functions, tmp_path, with_scales
):
  """Whether or not it was exported with its scaling, and though the new data differ."""
  policy = _exported(state, tmp_path)
  arrays = export.load_arrays(tmp_path)
  if not with_scales:
    arrays = {name: array for name, array in arrays.items() if not name.startswith("scaling/")}
  fresh = jax.jit(functions.init)(jax.random.PRNGKey(7))
  begun = training_state.with_policy(fresh, arrays)
  assert scaling.is_measured(begun.scaling) == with_scales
  if not with_scales:
    other = _rows(seed=9)
    other["state"] = 1.5 * other["state"] + 0.3
    scales = scaling.measure(other, LAYOUT)
    begun = training_state.with_scaling(begun, scales, keep_policy=True)
  image = np.random.default_rng(3).integers(0, 256, (6, 8, 3), dtype=np.uint8)
  for row in _rows(5, seed=4)["state"].astype(np.float32):
    expected = policy.step(image, row, policy.initial_state()).mean
    mean, stddev = _target_action(begun, image, row)
    np.testing.assert_allclose(mean, expected, rtol=1e-3, atol=2e-3)
    np.testing.assert_allclose(stddev, 0.1, atol=0.01)  # the noise begins anew
  new, old = begun.policy_optimiser, fresh.policy_optimiser
  jax.tree.map(np.testing.assert_array_equal, new, old)


def test_a_policy_of_other_networks_is_refused(state, tmp_path):
  _exported(state, tmp_path)
  wide = learning.make_learning(config.override(CONFIG, {"network.lstm_size": 6}), LAYOUT)
  fresh = jax.jit(wide.init)(jax.random.PRNGKey(0))
  with pytest.raises(ValueError, match="policy to begin with has other networks.*expected"):
    training_state.with_policy(fresh, export.load_arrays(tmp_path))


def test_updates_see_scaled_inputs_and_keep_the_scaling(functions, state):
  """Observations in other units, with the scaling in those units, give the same update."""
  rng = np.random.default_rng(0)
  fields = trajectory_fields(LAYOUT, lstm_size=4)
  replay = Replay(fields, length=6, capacity_steps=100)
  for _ in range(4):
    trajectory = {
      name: rng.normal(size=(6, *f.shape) if f.per_step else f.shape).astype(f.dtype)
      for name, f in fields.items()
    }
    replay.insert(trajectory | {"discount": np.ones(6, np.float32)})
  batch = replay.sample(rng, 4)
  unit = {"state": 8.0, "privileged": 0.25}  # powers of two: exact
  rescaled = batch | {name: batch[name] * factor for name, factor in unit.items()}
  scales = {
    name: {key: np.asarray(value) * unit[name] for key, value in state.scaling[name].items()}
    for name in unit
  }
  other = state._replace(scaling=jax.tree.map(jnp.array, scales))
  other = jax.tree.map(jnp.copy, other)
  before = jax.tree.map(np.array, state.scaling)
  new, metrics = functions.update(state, batch)
  _, rescaled_metrics = functions.update(other, rescaled)
  for name, value in metrics.items():
    np.testing.assert_allclose(value, rescaled_metrics[name], rtol=1e-4, err_msg=name)
  jax.tree.map(np.testing.assert_array_equal, new.scaling, before)


def test_without_scaling_nothing_is_kept_or_served():
  plain = config.override(CONFIG, {"scale_observations": False})
  state = jax.jit(learning.make_learning(plain, LAYOUT).init)(jax.random.PRNGKey(0))
  assert state.scaling == {} and scaling.is_measured(state.scaling)
  assert not [n for n in training_state.served_parameters(state) if n.startswith("scaling")]
