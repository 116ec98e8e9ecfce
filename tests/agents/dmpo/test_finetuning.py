"""From a student: the critic's warm-up, the KL to the student, burn-in, features of an encoder."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerf2real.agents.dmpo import config, learning, losses, networks, objective, training_state
from nerf2real.agents.dmpo.replay.features import FrozenEncoder
from nerf2real.agents.dmpo.specs import Layout
from tests.agents.dmpo.test_learning import CONFIG, LAYOUT, _batch, _same

STATE_LAYOUT = Layout(None, None, ("s",), (3,), (), (), 2)
DRAWN = config.override(CONFIG, {"student_kl": 0.5, "critic_warmup": 2})
PICTURES = config.override(CONFIG, {"n_step": 1, "augmentation.enabled": False})


def _begun(settings=DRAWN, layout=STATE_LAYOUT, seed=0):
  """A state whose policy has left its student."""
  functions = learning.make_learning(settings, layout)
  state = jax.jit(functions.init)(jax.random.key(seed))
  moved = jax.tree.map(
    lambda x, k: x + 0.1 * jax.random.normal(k, x.shape),
    state.policy,
    jax.tree.unflatten(
      jax.tree.structure(state.policy),
      list(jax.random.split(jax.random.key(9), len(jax.tree.leaves(state.policy)))),
    ),
  )
  return functions, state._replace(policy=moved, target_policy=jax.tree.map(jnp.copy, moved))


@functools.partial(jax.jit, static_argnames=("layout", "settings"))
def _jitted_gradient(trained, targets, batch, student, *, layout, settings):
  """Of the parameters that are trained; compiled once for each kind of batch."""
  return jax.grad(objective.total_loss, has_aux=True)(
    trained,
    *targets,
    batch=batch,
    key=jax.random.key(1),
    config=settings,
    layout=layout,
    student=student,
  )[0]


def _gradient(state, batch, *, student, layout=STATE_LAYOUT, settings=DRAWN):
  trained = (state.policy, state.critic, state.duals, state.belief)
  targets = (state.target_policy, state.target_critic)
  return _jitted_gradient(trained, targets, batch, student, layout=layout, settings=settings)


def test_only_the_critic_moves_while_it_warms_up():
  functions, state = _begun()
  before = jax.device_get(state._replace(key=jax.random.key_data(state.key)))
  batch = _batch(STATE_LAYOUT, 0, 6)
  for _ in range(3):
    state, metrics = functions.update_critic(state, batch)
  after = jax.device_get(state._replace(key=jax.random.key_data(state.key)))
  assert int(after.steps) == 3 and not _same(after.critic, before.critic)
  assert _same(after.target_critic, after.critic)  # copied at its period, 3
  for name in ("policy", "target_policy", "duals", "belief", "student", "policy_optimiser"):
    assert _same(getattr(after, name), getattr(before, name)), name
  assert set(metrics) == {"loss", "loss_critic", "critic_value", "reward", "gradient_critic"}
  state, _ = functions.update(state, batch | {"student_weight": np.float32(0.5)})
  assert not _same(jax.device_get(state.policy), before.policy)


def test_the_warm_up_does_what_the_whole_update_does_to_the_critic():
  _, state = _begun()
  batch = _batch(STATE_LAYOUT, 0, 6)
  whole = _gradient(state, batch | {"student_weight": np.float32(0.0)}, student={})[1]
  alone = jax.jit(
    jax.grad(
      lambda critic: objective.critic_objective(
        critic,
        state.target_policy,
        state.target_critic,
        batch=batch,
        key=jax.random.key(1),
        config=DRAWN,
      )[0]
    )
  )(state.critic)
  jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7), whole, alone)


def test_the_kl_term_pulls_the_policy_as_finite_differences_say():
  """Of the loss's gradient with the term, less that without it, in some entries of the mean."""
  _, state = _begun()
  batch = _batch(STATE_LAYOUT, 0, 6)
  weight = 0.5
  given = _gradient(state, batch | {"student_weight": np.float32(weight)}, student=state.student)[0]
  plain = _gradient(state, batch, student={})[0]
  found = np.asarray(given["mean"]["w"] - plain["mean"]["w"])

  inputs = np.asarray(batch["state"], np.float64)
  counts = np.asarray(objective.policy_weights(batch["discount"], batch["last"]), np.float64)

  def head(params):
    out = networks.policy_head(params, jnp.zeros((*inputs.shape[:2], 0)), inputs, DRAWN.network)
    return np.asarray(out.mean, np.float64), np.asarray(out.stddev, np.float64)

  def kl(mean_weights):
    """Closed form of KL(p || q) of diagonal Gaussians, in NumPy."""
    shifted = {**state.policy, "mean": {**state.policy["mean"], "w": jnp.asarray(mean_weights)}}
    (mean, stddev), (m, s) = head(shifted), head(state.student)
    each = np.log(s / stddev) + (stddev**2 + (mean - m) ** 2) / (2 * s**2) - 0.5
    return weight * (each.sum(-1) * counts).sum() / counts.sum()

  base = np.asarray(state.policy["mean"]["w"], np.float32)
  step = 3e-3
  for entry in ((0, 0), (1, 1), (2, 0)):
    up, down = base.copy(), base.copy()
    up[entry] += step
    down[entry] -= step
    expected = (kl(up) - kl(down)) / (2 * step)
    assert found[entry] == pytest.approx(expected, rel=2e-2, abs=1e-3)
  assert np.abs(found).max() > 0.01


def test_a_policy_that_is_its_student_is_not_pulled():
  functions = learning.make_learning(DRAWN, STATE_LAYOUT)
  state = jax.jit(functions.init)(jax.random.key(0))
  assert _same(state.student, state.policy)
  batch = _batch(STATE_LAYOUT, 0, 6) | {"student_weight": np.float32(10.0)}
  given, plain = _gradient(state, batch, student=state.student), _gradient(state, batch, student={})
  jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), given, plain)


def test_the_weight_falls_by_updates_and_by_returns():
  settings = config.override(
    CONFIG,
    {
      "student_kl": 0.4,
      "critic_warmup": 100,
      "student_kl_updates": 200,
      "student_kl_returns": [10.0, 30.0],
    },
  )
  for updates, found, expected in (
    (0, None, 0.4),
    (100, None, 0.4),
    (200, None, 0.2),
    (300, None, 0.0),
    (10_000, None, 0.0),
    (0, 10.0, 0.4),
    (0, 20.0, 0.2),
    (200, 25.0, 0.05),
    (0, 99.0, 0.0),
  ):
    assert learning.student_weight(settings, updates, found) == pytest.approx(expected)
  constant = config.override(CONFIG, {"student_kl": 0.4})
  assert learning.student_weight(constant, 10**6, 10.0) == 0.4
  with pytest.raises(ValueError, match="student_kl_returns must rise"):
    config.override(CONFIG, {"student_kl_returns": [3.0, 3.0]})


def test_the_student_is_the_policy_that_the_run_began_with_and_is_rescaled_with_it():
  settings = config.override(DRAWN, {"scale_observations": True})
  functions = learning.make_learning(settings, STATE_LAYOUT)
  source, fresh = (jax.jit(functions.init)(jax.random.key(seed)) for seed in (1, 2))
  state = training_state.with_policy(fresh, training_state.served_parameters(source))
  assert _same(state.student, state.policy) and not _same(state.student, fresh.policy)
  scales = {"state": {"mean": np.full(3, 2.0, np.float32), "stddev": np.full(3, 5.0, np.float32)}}
  scaled = training_state.with_scaling(state, scales, keep_policy=True)
  assert _same(scaled.student, scaled.policy)
  assert not _same(scaled.student, state.student)


def test_what_lies_in_the_burn_in_counts_for_nothing():
  """Other actions and rewards there change no gradient; the pictures reach the LSTM alone."""
  state = jax.jit(learning.make_learning(PICTURES, LAYOUT).init)(jax.random.key(0))
  batch = _batch(LAYOUT, 4, 6)
  batch["last"] = np.full(4, 5, np.int32)
  batch["burn_in"] = np.full(4, 3, np.int32)
  other = {name: array.copy() for name, array in batch.items()}
  other["state"][:, 0] += 7.0
  other["privileged"][:, 0] += 7.0

  def gradient(batch):
    return _gradient(state, batch, student={}, layout=LAYOUT, settings=PICTURES)

  def same(a, b):
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)

  found, again = gradient(batch), gradient(other)
  for part in (0, 1, 3):  # policy, critic, belief
    jax.tree.map(same, found[part], again[part])
  without = gradient({**batch, "burn_in": np.zeros(4, np.int32)})
  for part in (0, 1, 3):
    assert not _same(found[part], without[part])


def test_no_gradient_reaches_back_into_the_burn_in():
  params = networks.init_policy(jax.random.key(0), CONFIG.network, LAYOUT)["lstm"]
  features = jnp.asarray(np.random.default_rng(0).normal(size=(2, 6, 5)), jnp.float32)
  zero = networks.LstmState(jnp.zeros((2, 4)), jnp.zeros((2, 4)))

  def last_output(features):
    burn = jnp.array([3, 0])
    return networks.unroll_lstm(params, zero, features, burn)[:, -1].sum()

  found = np.asarray(jax.grad(last_output)(features))
  assert not found[0, :3].any() and found[0, 3:].all() and found[1].all()
  plain = networks.unroll_lstm(params, zero, features)
  burned = networks.unroll_lstm(params, zero, features, jnp.array([3, 0]))
  np.testing.assert_array_equal(plain, burned)


def test_features_of_a_frozen_encoder_stand_for_the_pictures():
  settings = config.override(PICTURES, {"frozen_encoder": True, "feature_copies": 3})
  state = jax.jit(learning.make_learning(settings, LAYOUT).init)(jax.random.key(0))
  encoder = FrozenEncoder(state.policy, settings, length=6, seed=0)
  batch = _batch(LAYOUT, 4, 6)
  stored = np.stack([encoder.encode(images) for images in batch["image"]])
  assert stored.shape == (4, 6, 3, 5) and stored.dtype == np.float16
  features = {name: a for name, a in batch.items() if name != "image"} | {"features": stored}
  by_features = _gradient(state, features, student={}, layout=LAYOUT, settings=settings)
  by_pictures = _gradient(state, batch, student={}, layout=LAYOUT, settings=PICTURES)
  assert not any(x.any() for x in jax.tree.leaves(by_features[0]["resnet"]))
  for name in ("lstm", "mlp", "mean"):
    jax.tree.map(
      lambda a, b: np.testing.assert_allclose(a, b, rtol=0.05, atol=0.02),
      by_features[0][name],
      by_pictures[0][name],
    )


def test_outputs_of_a_frozen_lstm_stand_for_pictures_and_states():
  settings = config.override(
    PICTURES, {"frozen_encoder": True, "frozen_memory": True, "feature_copies": 2}
  )
  state = jax.jit(learning.make_learning(settings, LAYOUT).init)(jax.random.key(0))
  encoder = FrozenEncoder(state.policy, settings, length=4, seed=0)  # 4 and 2 frames
  batch = _batch(LAYOUT, 4, 6)
  names = ("image", "lstm_hidden", "lstm_cell")
  whole = [
    encoder.replace({name: batch[name][i] for name in names}) for i in range(len(batch["image"]))
  ]
  stored = np.stack([w["embedding"] for w in whole])
  assert stored.shape == (4, 6, 2, 4) and {name for w in whole for name in w} == {"embedding"}
  embedded = {name: a for name, a in batch.items() if name not in names} | {"embedding": stored}
  by_memory = _gradient(state, embedded, student={}, layout=LAYOUT, settings=settings)
  by_pictures = _gradient(state, batch, student={}, layout=LAYOUT, settings=PICTURES)
  for name in ("resnet", "lstm"):
    assert not any(x.any() for x in jax.tree.leaves(by_memory[0][name])), name
  jax.tree.map(
    lambda a, b: np.testing.assert_allclose(a, b, rtol=0.05, atol=0.02),
    (by_memory[0]["mlp"], by_memory[0]["mean"], by_memory[1]),
    (by_pictures[0]["mlp"], by_pictures[0]["mean"], by_pictures[1]),
  )


def test_copies_of_features_differ_by_the_augmentation_alone():
  state = jax.jit(learning.make_learning(CONFIG, LAYOUT).init)(jax.random.key(0))
  images = _batch(LAYOUT, 4, 6)["image"][0]
  found = FrozenEncoder(state.policy, CONFIG, length=4, seed=0).encode(images)  # 4 and 2 frames
  flat = networks.resnet(state.policy["resnet"], images / np.float32(255), CONFIG.network)
  np.testing.assert_allclose(found[:, 0], flat, atol=2e-3, rtol=2e-3)
  assert np.abs(found[:, 1] - found[:, 0]).max() > 1e-3


def test_the_kl_is_that_of_the_policy_from_the_student():
  p = losses.Gaussian(jnp.array([[0.2]]), jnp.array([[0.5]]))
  q = losses.Gaussian(jnp.array([[0.0]]), jnp.array([[1.0]]))
  expected = np.log(2.0) + (0.25 + 0.04) / 2 - 0.5
  assert float(losses.kl_per_dimension(p, q)[0, 0]) == pytest.approx(expected, rel=1e-5)
