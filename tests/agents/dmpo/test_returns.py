"""n-step targets, projection and critic loss against rlax and numbers made by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerf2real.agents.dmpo import returns

T, K = 9, 11


def _rlax():
  return pytest.importorskip("rlax", reason="rlax (the test extra) is not installed")


@pytest.mark.parametrize("n", [1, 3, 5, 20])
def test_n_step_returns_agree_with_rlax(n):
  rlax = _rlax()
  rng = np.random.default_rng(n)
  rewards = rng.normal(size=T - 1).astype(np.float32)
  discounts = 0.97 * rng.integers(0, 2, T - 1).astype(np.float32)
  values = rng.normal(size=T).astype(np.float32)
  steps = returns.n_step_targets(
    jnp.asarray(rewards), jnp.asarray(discounts), jnp.asarray(T - 1), n=n
  )
  ours = steps.returns + steps.discounts * values[steps.bootstrap]
  theirs = rlax.n_step_bootstrapped_returns(
    jnp.asarray(rewards), jnp.asarray(discounts), jnp.asarray(values[1:]), n
  )
  np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)


def test_padding_is_never_reached():
  """With last = 3, steps 0..2 count and nothing at or beyond step 3 is summed."""
  rewards = jnp.array([1.0, 2.0, 4.0, 1000.0, 1000.0])
  steps = returns.n_step_targets(rewards, jnp.full(5, 0.5), jnp.asarray(3), n=2)
  np.testing.assert_allclose(steps.returns[:3], [2.0, 4.0, 4.0])
  np.testing.assert_allclose(steps.discounts, [0.25, 0.25, 0.5, 0.0, 0.0])
  np.testing.assert_array_equal(steps.bootstrap[:3], [2, 3, 3])


def test_termination_stops_the_sum():
  steps = returns.n_step_targets(jnp.ones(4), jnp.array([0.9, 0.0, 0.9, 0.9]), jnp.asarray(4), n=3)
  np.testing.assert_allclose(steps.returns, [1.9, 1.0, 1.9, 1.0], rtol=1e-6)
  np.testing.assert_allclose(steps.discounts[:2], [0.0, 0.0])


def test_projection_agrees_with_rlax():
  rlax = _rlax()
  rng = np.random.default_rng(0)
  atoms = jnp.linspace(-150.0, 150.0, K)
  positions = jnp.asarray(rng.uniform(-250, 250, (6, K)), jnp.float32)
  probabilities = jnp.asarray(rng.dirichlet(np.ones(K), 6), jnp.float32)
  theirs = jax.vmap(rlax.categorical_l2_project, (0, 0, None))(positions, probabilities, atoms)
  ours = returns.categorical_project(positions, probabilities, atoms)
  np.testing.assert_allclose(ours, theirs, atol=1e-5)
  np.testing.assert_allclose(ours.sum(-1), 1.0, rtol=1e-5)


def test_projection_by_hand():
  atoms = jnp.array([0.0, 1.0, 2.0])
  ours = returns.categorical_project(jnp.array([[0.25, 9.0]]), jnp.array([[0.8, 0.2]]), atoms)
  np.testing.assert_allclose(ours, [[0.6, 0.2, 0.2]], atol=1e-6)


def test_critic_loss_is_least_at_the_target():
  """Its gradient in the logits is softmax(logits) - target; checked by differences too."""
  with jax.enable_x64(True):
    atoms = jnp.linspace(-2.0, 2.0, 5)
    probabilities = jnp.array([[0.1, 0.2, 0.4, 0.2, 0.1]])
    arguments = {
      "returns": jnp.array([0.3]),
      "discounts": jnp.array([0.5]),
      "target_probabilities": probabilities,
      "atoms": atoms,
    }
    target = returns.categorical_project(0.3 + 0.5 * atoms[None], probabilities, atoms)

    def loss(logits):
      return returns.categorical_critic_loss(logits, **arguments)[0]

    logits = jnp.array([[0.3, -0.2, 0.5, 0.0, 0.1]])
    gradient = jax.grad(loss)(logits)
    np.testing.assert_allclose(gradient, jax.nn.softmax(logits) - target, atol=1e-10)
    for i in range(5):
      shift = jnp.zeros((1, 5)).at[0, i].set(1e-6)
      difference = (loss(logits + shift) - loss(logits - shift)) / 2e-6
      np.testing.assert_allclose(gradient[0, i], difference, atol=1e-8)
    np.testing.assert_allclose(jax.grad(loss)(jnp.log(target + 1e-30)), 0.0, atol=1e-10)
