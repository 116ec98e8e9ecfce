"""The belief: its density, wrapped yaw, error, stopped gradients and picture."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from nerf2real.agents.dmpo import belief, specs
from nerf2real.agents.dmpo.config import NetworkConfig
from nerf2real.agents.dmpo.policy import belief_plot
from nerf2real.core.floor_map import FloorMap


def _mixture(seed=0):
  rng = np.random.default_rng(seed)
  return belief.Belief(
    jnp.asarray(rng.normal(size=(2, 5)), jnp.float32),
    jnp.asarray(rng.normal(size=(2, 5, 3)), jnp.float32),
    jnp.asarray(rng.uniform(0.2, 1, (2, 5, 3)), jnp.float32),
  )


def test_density_agrees_with_scipy():
  mixture, pose = _mixture(), np.array([[0.1, -0.3, 0.2], [0.5, 0.2, -0.4]], np.float32)
  share = jax.nn.softmax(mixture.logits)
  expected = [
    np.log(
      sum(
        share[b, m]
        * scipy.stats.norm.pdf(pose[b], mixture.means[b, m], mixture.stddevs[b, m]).prod()
        for m in range(5)
      )
    )
    for b in range(2)
  ]
  np.testing.assert_allclose(belief.log_likelihood(mixture, pose), expected, rtol=1e-4)


def test_yaw_is_a_circle():
  mixture = _mixture()
  pose = jnp.array([[0.1, 0.2, 3.1], [0.1, 0.2, -0.5]])
  turned = pose.at[:, 2].add(2 * jnp.pi)
  np.testing.assert_allclose(
    belief.log_likelihood(mixture, pose), belief.log_likelihood(mixture, turned), rtol=1e-3
  )
  np.testing.assert_allclose(belief.wrap_angle(jnp.array([np.pi, 3.5])), [np.pi, 3.5 - 2 * np.pi])


def test_error_is_the_distance_of_the_mean():
  mixture = belief.Belief(
    jnp.log(jnp.array([[0.25, 0.75]])),
    jnp.array([[[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]]),
    jnp.ones((1, 2, 3)),
  )
  error = belief.localisation_error(mixture, jnp.array([[3.0, 4.0, 0.0]]))
  np.testing.assert_allclose(error, [4.0], rtol=1e-6)


def test_no_gradient_reaches_the_embedding():
  params = belief.init_belief(jax.random.key(0), NetworkConfig(belief_layers=(8,)), 6)
  pose = jnp.zeros((2, 3))

  def loss(params, embedding):
    return belief.log_likelihood(belief.predict(params, embedding), pose).sum()

  own, through = jax.grad(loss, (0, 1))(params, jnp.ones((2, 6)))
  assert np.abs(through).max() == 0
  assert max(np.abs(x).max() for x in jax.tree.leaves(own)) > 0


def test_pose_of_a_privileged_vector():
  yaw = 2.0
  rotation = np.array([np.cos(yaw), -np.sin(yaw), 0, np.sin(yaw), np.cos(yaw), 0, 0, 0, 1])
  vector = np.concatenate([[9.0], [1.0, 2.0, 0.3], rotation]).astype(np.float32)
  np.testing.assert_allclose(specs.planar_pose(vector, (1, 4)), [1.0, 2.0, 2.0], rtol=1e-5)


def test_heat_map_puts_mass_and_marks_where_they_belong():
  extent = (-2.0, 2.0, -1.0, 1.0)
  mixture = np.zeros(1), np.array([[1.0, 0.5, 0.0]]), np.full((1, 3), 0.1)
  density = belief_plot.position_density(*mixture, extent=extent, cell=0.05)
  np.testing.assert_allclose(density.sum() * 0.05**2, 1.0, rtol=1e-3)
  row, column = np.unravel_index(density.argmax(), density.shape)
  assert column > 0.7 * density.shape[1] and row < 0.3 * density.shape[0]
  floor = FloorMap(extent, np.zeros((240, 480, 3), np.uint8))
  picture = belief_plot.draw(
    floor, *mixture, truth=np.array([-1.0, 0.0]), target=np.array([-1.0, -0.5])
  )
  assert not floor.picture.any() and picture[60, 360].min() > 100  # mass at (1, 0.5)
  height, width = picture.shape[:2]
  assert picture[height // 2, width // 4].min() > 200  # the white X
  red, green, blue = picture[3 * height // 4, width // 4].astype(int)
  assert green > 150 > max(red, blue)  # the green triangle
