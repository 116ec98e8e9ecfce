"""The update: what moves, what does not, padding, and a problem with a known answer."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerf2real.agents.dmpo import config, learning, networks, objective, presets
from nerf2real.agents.dmpo.replay.ring import Replay, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout

LAYOUT = Layout(
  "camera",
  (6, 8, 3),
  ("s",),
  (3,),
  ("privileged/robot_position", "privileged/robot_rotation"),
  (3, 9),
  2,
)
CONFIG = config.override(
  config.DmpoConfig(),
  {
    "network.policy_layers": (8,),
    "network.critic_layers": (8,),
    "network.image_channels": (3,),
    "network.image_blocks": 1,
    "network.image_features": 5,
    "network.lstm_size": 4,
    "network.belief_layers": (6,),
    "trajectory_length": 6,
    "num_samples": 4,
    "target_actor_period": 2,
    "target_critic_period": 3,
    "min_replay_steps": 1,
  },
)


def _batch(layout, lstm_size, length, size=4, seed=0):
  rng = np.random.default_rng(seed)
  fields = trajectory_fields(layout, lstm_size=lstm_size)
  replay = Replay(fields, length=length, capacity_steps=100)
  for steps in (length, length - 2, length, 2):
    trajectory = {
      name: rng.normal(size=(steps, *f.shape) if f.per_step else f.shape).astype(f.dtype)
      for name, f in fields.items()
    }
    trajectory["discount"] = np.ones(steps, np.float32)
    replay.insert(trajectory)
  return replay.sample(rng, size)


@pytest.fixture(scope="module")
def vision():
  functions = learning.make_learning(CONFIG, LAYOUT)
  state = jax.jit(functions.init)(jax.random.key(0))
  batch = _batch(LAYOUT, 4, 6)
  states, metrics = (
    [jax.tree.map(np.asarray, state._replace(key=jax.random.key_data(state.key)))],
    [],
  )
  for _ in range(3):
    state, m = functions.update(state, batch)
    states.append(jax.tree.map(np.asarray, state._replace(key=jax.random.key_data(state.key))))
    metrics.append(jax.tree.map(float, m))
  return states, metrics


def _same(a, b):
  return all(jax.tree.leaves(jax.tree.map(lambda x, y: bool((x == y).all()), a, b)))


@functools.partial(jax.jit, static_argnames="layout")
def _jitted_gradients(parameters, batch, *, layout):
  return jax.grad(objective.total_loss, (0, 1, 2), has_aux=True)(
    *parameters, batch=batch, key=jax.random.key(1), config=CONFIG, layout=layout
  )[0]


def _gradients(state, batch, layout):
  """Of what is trained, the target policy and the target critic."""
  trained = (state.policy, state.critic, state.duals, state.belief)
  parameters = (trained, state.target_policy, state.target_critic)
  return _jitted_gradients(parameters, batch, layout=layout)


def test_targets_are_copied_at_their_periods(vision):
  states, _ = vision
  assert _same(states[1].target_policy, states[0].policy)
  assert _same(states[2].target_policy, states[2].policy)
  assert _same(states[3].target_policy, states[2].policy)
  assert _same(states[2].target_critic, states[0].critic)
  assert _same(states[3].target_critic, states[3].critic)
  assert not _same(states[3].critic, states[2].critic)


def test_everything_that_learns_moves_and_is_finite(vision):
  states, metrics = vision
  moved = jax.tree.map(lambda a, b: bool((a != b).any()), states[0], states[2])
  for part in (moved.policy, moved.critic, moved.duals, moved.belief):
    assert all(jax.tree.leaves(part))
  assert all(np.isfinite(list(m.values())).all() for m in metrics)
  assert {"loss_critic", "loss_policy", "kl_mean", "belief_error", "temperature"} <= set(metrics[0])
  assert int(states[3].steps) == 3


def test_padding_has_no_influence():
  """Rubbish behind a trajectory's last observation changes no gradient."""
  layout = Layout(None, None, ("s",), (3,), (), (), 2)
  functions = learning.make_learning(CONFIG, layout)
  state = jax.jit(functions.init)(jax.random.key(0))
  batch = _batch(layout, 0, 6)
  assert (batch["last"] < 5).any()
  rubbish = {k: v.copy() for k, v in batch.items()}
  for b, last in enumerate(batch["last"]):
    for name in ("state", "action", "reward", "discount"):
      rubbish[name][b, last + 1 :] = 7.0

  found = _gradients(state, batch, layout)
  jax.tree.map(
    lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-8),
    found,
    _gradients(state, rubbish, layout),
  )
  of_targets = found[1:]
  assert all(not x.any() for x in jax.tree.leaves(of_targets))  # nothing reaches the targets


def test_terminal_states_and_padding_do_not_count_for_the_policy():
  """Cut at the end, terminated at the end, terminated early with padding, cut early."""
  discount = jnp.array([[1, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 0], [1, 1, 0, 0]], jnp.float32)
  last = jnp.array([3, 3, 2, 2])
  expected = [[1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 0, 0], [1, 1, 1, 0]]
  np.testing.assert_array_equal(objective.policy_weights(discount, last), expected)


def test_a_terminal_observation_reaches_no_gradient_of_the_policy():
  layout = Layout(None, None, ("s",), (3,), (), (), 2)
  functions = learning.make_learning(CONFIG, layout)
  state = jax.jit(functions.init)(jax.random.key(0))
  batch = _batch(layout, 0, 6)
  ends = batch["last"][:, None] == np.arange(1, 7)  # the action before the last observation
  batch = batch | {"discount": np.where(ends, 0.0, batch["discount"]).astype(np.float32)}
  other = batch | {"state": batch["state"].copy()}
  for b, last in enumerate(batch["last"]):
    other["state"][b, last] = 5.0

  same = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-8)  # noqa: E731
  of_trained = [_gradients(state, b, layout)[0] for b in (batch, other)]
  jax.tree.map(same, *of_trained)


def test_the_first_policy_stands():
  layout = Layout(None, None, ("s",), (3,), (), (), 2)
  settings = config.override(CONFIG, {"network.init_stddev": 0.1})
  standing = np.array([0.4, -0.7], np.float32)
  functions = learning.make_learning(settings, layout, first_action=standing)
  state = jax.jit(functions.init)(jax.random.key(0))
  observation = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
  for policy in (state.policy, state.target_policy):
    out = networks.policy_head(policy, jnp.zeros((50, 0)), observation, settings.network)
    np.testing.assert_allclose(out.mean, np.tile(standing, (50, 1)), atol=0.05)
    np.testing.assert_allclose(out.stddev, 0.1, atol=0.005)


def test_it_learns_a_one_step_problem():
  """reward = 1 - (a - 0.5)^2 and nothing follows: the mean goes to 0.5, the value to about 1."""
  layout = Layout(None, None, ("s",), (1,), (), (), 1)
  settings = config.override(
    presets.preset("state"),
    {
      "network.policy_layers": (16,),
      "network.critic_layers": (32, 32),
      "network.vmin": -3.0,
      "network.vmax": 2.0,
      "trajectory_length": 2,
      "policy_learning_rate": 5e-3,
      "critic_learning_rate": 5e-3,
      "target_critic_period": 20,
      "epsilon_mean": 0.05,
      "epsilon_stddev": 1e-3,
      "init_log_alpha_stddev": 1.0,
      "init_log_alpha_mean": 1.0,
      "init_log_temperature": -1.0,
    },
  )
  functions = learning.make_learning(settings, layout)
  state = jax.jit(functions.init)(jax.random.key(0))
  rng = np.random.default_rng(0)
  for _ in range(200):
    actions = rng.uniform(-1, 1, (64, 2, 1)).astype(np.float32)
    batch = {
      "state": np.ones((64, 2, 1), np.float32),
      "privileged": np.zeros((64, 2, 0), np.float32),
      "action": actions,
      "reward": 1 - (actions[..., 0] - 0.5) ** 2,
      "discount": np.zeros((64, 2), np.float32),
      "last": np.ones(64, np.int32),
    }
    state, metrics = functions.update(state, batch)
  head = networks.policy_head(state.policy, jnp.zeros((1, 0)), jnp.ones((1, 1)), settings.network)
  assert abs(float(head.mean[0, 0]) - 0.5) < 0.15
  assert float(head.stddev[0, 0]) < 0.6
  assert 0.6 < float(metrics["q_mean"]) < 1.05
