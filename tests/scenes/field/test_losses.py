import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.scenes.field import losses as field_losses


def _step_function(rays=6, intervals=9, seed=0):
  rng = np.random.default_rng(seed)
  edges = np.sort(rng.uniform(size=(rays, intervals + 1)), axis=-1)
  weights = rng.dirichlet(np.ones(intervals), rays) * 0.9
  return jnp.asarray(edges), jnp.asarray(weights)


def test_charbonnier_by_hand():
  color, target = jnp.array([[0.3, 0.5, 0.0]]), jnp.array([[0.0, 0.1, 0.0]])
  expected = (np.sqrt(0.09 + 0.01) + np.sqrt(0.16 + 0.01) + 0.1) / 3
  np.testing.assert_allclose(field_losses.charbonnier(color, target, padding=0.1), expected)


def test_distortion_agrees_with_the_double_sum():
  edges, weights = _step_function()
  middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
  pairs = jnp.abs(middle[:, :, None] - middle[:, None, :])
  between = jnp.einsum("ri,rj,rij->r", weights, weights, pairs)
  within = jnp.sum(weights**2 * jnp.diff(edges), axis=-1) / 3
  np.testing.assert_allclose(
    field_losses.distortion(weights, edges), jnp.mean(between + within), rtol=1e-5
  )


def test_interlevel_is_zero_for_a_proposal_that_covers_the_field():
  edges, weights = _step_function()
  assert float(field_losses.interlevel(edges, weights, edges, weights)) < 1e-9
  assert float(field_losses.interlevel(edges, weights, edges, 0.5 * weights)) > 1e-3


def test_interlevel_by_hand_and_its_gradient():
  edges, weights = jnp.array([[0.2, 0.4]]), jnp.array([[0.5]])
  proposal_edges, proposal = jnp.array([[0.0, 0.3, 0.6, 1.0]]), jnp.array([[0.1, 0.2, 0.7]])

  def loss(field_weights, proposal_weights):
    return field_losses.interlevel(edges, field_weights, proposal_edges, proposal_weights)

  np.testing.assert_allclose(loss(weights, proposal), (0.5 - 0.3) ** 2 / 0.5, rtol=1e-5)
  by_field, by_proposal = jax.grad(loss, argnums=(0, 1))(weights, proposal)
  assert float(jnp.abs(by_field).max()) == 0.0
  np.testing.assert_allclose(by_proposal, [[-0.8, -0.8, 0.0]], rtol=1e-5)


def test_anchor_is_the_mean_distance_of_the_light_from_its_point():
  edges = jnp.array([[0.0, 0.2, 0.6], [0.0, 0.2, 0.6]])
  weights = jnp.array([[0.5, 0.25], [0.5, 0.25]])
  goals, known = jnp.array([0.4, 0.0]), jnp.array([True, False])
  by_hand = 0.5 * 0.3 + 0.25 * 0.0 + 0.25 * 0.6  # the middles lie at 0.1 and 0.4
  found = field_losses.anchor(weights, edges, goals, known)
  np.testing.assert_allclose(found, by_hand / 2, rtol=1e-6)
