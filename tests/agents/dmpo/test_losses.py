"""The losses against rlax (an independent implementation), hand-made numbers and differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerf2real.agents.dmpo import losses
from nerf2real.agents.dmpo.losses import Gaussian, MpoEpsilons

N, B, D = 7, 5, 3
EPSILONS = MpoEpsilons(0.1, 0.0025, 1e-6, 0.001)


def _inputs(seed: int = 0, dtype=np.float32):
  rng = np.random.default_rng(seed)
  online = Gaussian(rng.normal(size=(B, D)), rng.uniform(0.2, 1.0, (B, D)))
  target = Gaussian(rng.normal(size=(B, D)), rng.uniform(0.2, 1.0, (B, D)))
  actions = target.mean + target.stddev * rng.normal(size=(N, B, D))
  values = rng.normal(size=(N, B)) * 3
  duals = losses.DualParams(
    np.asarray(1.3), rng.normal(size=D) + 1, rng.normal(size=D) + 4, np.asarray(0.4)
  )
  return jax.tree.map(lambda x: jnp.asarray(x, dtype), (duals, online, target, actions, values))


@functools.partial(jax.jit, static_argnames="penalty")
def _ours(duals, online, target, actions, values, *, penalty, weights=None):
  return losses.mpo_loss(
    duals,
    online,
    target=target,
    actions=actions,
    values=values,
    weights=jnp.ones(values.shape[1]) if weights is None else weights,
    epsilons=EPSILONS,
    action_penalization=penalty,
  )


@functools.partial(jax.jit, static_argnames="penalty")
def _rlax(duals, online, target, actions, values, *, penalty):
  rlax = pytest.importorskip("rlax", reason="rlax (the test extra) is not installed")
  project = losses.positive
  log_probs = sum(
    jax.scipy.stats.norm.logpdf(actions, g.mean, g.stddev).sum(-1)
    for g in (Gaussian(online.mean, target.stddev), Gaussian(target.mean, online.stddev))
  )

  def kl(p, q):  # written out in another way: cross-entropy minus entropy
    entropy = 0.5 * jnp.log(2 * jnp.pi * jnp.e * p.stddev**2)
    cross = 0.5 * jnp.log(2 * jnp.pi * q.stddev**2)
    return cross + (p.stddev**2 + (p.mean - q.mean) ** 2) / (2 * q.stddev**2) - entropy

  penalise = functools.partial(rlax.LagrangePenalty, per_dimension=True)
  constraints = [
    (
      kl(target, Gaussian(online.mean, target.stddev)),
      penalise(duals.alpha_mean, jnp.asarray(EPSILONS.epsilon_mean)),
    ),
    (
      kl(target, Gaussian(target.mean, online.stddev)),
      penalise(duals.alpha_stddev, jnp.asarray(EPSILONS.epsilon_stddev)),
    ),
  ]
  temperature = rlax.LagrangePenalty(duals.temperature, jnp.asarray(EPSILONS.epsilon))
  loss, _ = rlax.mpo_loss(log_probs, values, temperature, constraints, project)
  if penalty:
    cost = -jnp.sqrt(jnp.sum((actions - jnp.clip(actions, -1, 1)) ** 2, -1))
    dual_loss, weights, _ = rlax.mpo_compute_weights_and_temperature_loss(
      cost,
      rlax.LagrangePenalty(duals.penalty_temperature, jnp.asarray(EPSILONS.epsilon_penalty)),
      project,
    )
    weights = jax.lax.stop_gradient(weights)
    loss = loss + dual_loss - jnp.sum(weights * log_probs, axis=0)
  return loss.mean()


@pytest.mark.parametrize("penalty", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_mpo_agrees_with_rlax(seed, penalty):
  inputs = _inputs(seed)
  np.testing.assert_allclose(
    _ours(*inputs, penalty=penalty)[0], _rlax(*inputs, penalty=penalty), rtol=1e-5, atol=1e-5
  )


@pytest.mark.parametrize("penalty", [False, True])
def test_gradients_agree_with_rlax(penalty):
  duals, online, *rest = _inputs(3)
  ours = jax.jit(jax.grad(lambda d, o: _ours(d, o, *rest, penalty=penalty)[0], (0, 1)))
  theirs = jax.jit(jax.grad(lambda d, o: _rlax(d, o, *rest, penalty=penalty), (0, 1)))
  compare = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
  jax.tree.map(compare, ours(duals, online), theirs(duals, online))


def test_gradients_agree_with_finite_differences():
  """Of the policy, with multipliers held as the M-step holds them."""
  with jax.enable_x64(True):
    duals, online, *rest = _inputs(4, np.float64)

    def loss(mean, stddev):
      return _ours(duals, Gaussian(mean, stddev), *rest, penalty=True)[0]

    # alpha (eps - sg(KL)) has no gradient for the policy, but its value moves with the KL: add the
    # same number without the multipliers' loss.
    def value(mean, stddev):
      total, metrics = _ours(duals, Gaussian(mean, stddev), *rest, penalty=True)
      return total - metrics["loss_alpha"]

    value = jax.jit(value)
    gradients = jax.jit(jax.grad(loss, (0, 1)))(online.mean, online.stddev)
    step = 1e-6
    for argument, (array, gradient) in enumerate(zip(online, gradients, strict=True)):
      for index in [(0, 0), (2, 1), (4, 2)]:
        shift = jnp.zeros_like(array).at[index].set(step)
        arguments = [list(online), list(online)]
        arguments[0][argument] = array + shift
        arguments[1][argument] = array - shift
        difference = (value(*arguments[0]) - value(*arguments[1])) / (2 * step)
        np.testing.assert_allclose(gradient[index], difference, rtol=1e-5, atol=1e-7)


def test_kl_is_that_of_samples():
  rng = np.random.default_rng(0)
  p, q = Gaussian(np.array([0.3]), np.array([0.5])), Gaussian(np.array([-0.2]), np.array([0.8]))
  x = (p.mean + p.stddev * rng.normal(size=(400_000, 1))).astype(np.float32)
  estimate = float(jnp.mean(losses.log_prob(p, x) - losses.log_prob(q, x)))
  np.testing.assert_allclose(losses.kl_per_dimension(p, q)[0], estimate, atol=5e-3)
  np.testing.assert_allclose(losses.kl_per_dimension(p, p), 0.0, atol=1e-7)


def test_padding_does_not_count():
  duals, online, target, actions, values = _inputs(5)
  weights = jnp.array([1.0, 1.0, 1.0, 0.0, 0.0])
  padded, _ = _ours(duals, online, target, actions, values, penalty=True, weights=weights)
  cut = lambda x: x[..., :3, :]  # noqa: E731
  whole, _ = _ours(
    duals,
    Gaussian(*map(cut, online)),
    Gaussian(*map(cut, target)),
    cut(actions),
    values[:, :3],
    penalty=True,
  )
  np.testing.assert_allclose(padded, whole, rtol=1e-6)


def test_one_bound_for_all_dimensions():
  duals, *rest = _inputs(6)
  joint = duals._replace(alpha_mean=jnp.ones(1), alpha_stddev=jnp.ones(1))
  each = duals._replace(alpha_mean=jnp.ones(D), alpha_stddev=jnp.ones(D))
  _, one = _ours(joint, *rest, penalty=False)
  _, many = _ours(each, *rest, penalty=False)
  np.testing.assert_allclose(one["loss_kl"], many["loss_kl"], rtol=1e-6)
  np.testing.assert_allclose(one["kl_mean"], D * many["kl_mean"], rtol=1e-6)


def test_out_of_bounds_cost():
  actions = jnp.array([[0.5, -0.9], [4.0, 5.0], [1.0, -1.5]])
  np.testing.assert_allclose(losses.out_of_bounds_cost(actions), [0.0, -5.0, -0.5], rtol=1e-6)


def test_duals_start_and_stay_positive():
  duals = losses.init_duals(2, log_temperature=10, log_alpha_mean=10, log_alpha_stddev=1000)
  np.testing.assert_allclose(losses.positive(duals.alpha_stddev), [1000, 1000])
  low = losses.clip_duals(duals._replace(temperature=jnp.asarray(-500.0)))
  assert float(low.temperature) == -18.0
  assert float(losses.positive(low.temperature)) > 0


def test_wrong_rank_is_refused():
  duals, online, target, actions, values = _inputs()
  with pytest.raises(ValueError, match="values has shape"):
    _ours(duals, online, target, actions, values[None], penalty=True, weights=jnp.ones(B))
