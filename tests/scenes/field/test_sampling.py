import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.scenes.field import sampling


def test_spacing_known_values_and_inverse():
  distances = jnp.array([0.0, 0.4, 1.0, 2.0, 10.0])
  np.testing.assert_allclose(sampling.spacing(distances), [0, 0.2, 0.5, 0.75, 0.95], atol=1e-6)
  np.testing.assert_allclose(
    sampling.inverse_spacing(sampling.spacing(distances)), distances, rtol=1e-5
  )


def test_interval_weights_by_hand():
  density, length = np.array([1.0, 0.0, 2.0]), np.array([0.5, 3.0, 1.0])
  a0, a2 = 1 - np.exp(-0.5), 1 - np.exp(-2.0)
  expected = [a0, 0.0, (1 - a0) * a2]
  found = sampling.interval_weights(jnp.asarray(density), jnp.asarray(length))
  np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_stratified_edges_are_sorted_and_within_bounds():
  edges = sampling.stratified(jax.random.PRNGKey(0), 50, 16, near=0.1, far=10.0)
  assert edges.shape == (50, 17)
  assert (np.diff(np.asarray(edges)) > 0).all()
  assert edges.min() >= 0.05 and edges.max() <= 0.95


def test_resample_follows_the_weights():
  edges = jnp.broadcast_to(jnp.linspace(0.0, 1.0, 5), (2000, 5))
  weights = jnp.broadcast_to(jnp.array([0.0, 0.75, 0.0, 0.25]), (2000, 4))
  drawn = np.asarray(sampling.resample(jax.random.PRNGKey(0), edges, weights, 31))
  assert drawn.shape == (2000, 32) and (np.diff(drawn) >= 0).all()
  share = np.histogram(drawn, bins=[0, 0.25, 0.5, 0.75, 1.0])[0] / drawn.size
  np.testing.assert_allclose(share, [0, 0.75, 0, 0.25], atol=0.01)


def test_dilation_is_the_maximum_within_the_window():
  edges = jnp.array([[0.0, 0.4, 0.5, 1.0]])
  weights = jnp.array([[0.0, 0.6, 0.0]])
  new_edges, new_weights = sampling.dilate(edges, weights, dilation=0.1)
  centres = 0.5 * (np.asarray(new_edges)[0, 1:] + np.asarray(new_edges)[0, :-1])
  mass = np.asarray(new_weights)[0]
  np.testing.assert_allclose(mass.sum(), 0.6, rtol=1e-5)
  assert mass[(centres < 0.3) | (centres > 0.6)].max() < 1e-6
  width = np.diff(np.asarray(new_edges)[0])
  inside = (centres > 0.3) & (centres < 0.6) & (width > 1e-6)
  np.testing.assert_allclose(mass[inside] / width[inside], 0.6 / 0.3, rtol=1e-4)
