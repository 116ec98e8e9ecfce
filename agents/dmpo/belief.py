"""The belief head: localisation as a mixture of Gaussians over x, y and yaw.

An MLP on the policy's recurrent image embedding, for analysis only: no gradient reaches the policy.
Source: Byravan et al. 2022 (NeRF2Real), "Navigation and obstacle avoidance results" (a mixture of
five Gaussians; the localisation error is the distance between its mean and the true position) and
the figure "Localization performance of the agent". Where the paper is silent: components are
diagonal (chosen: the fewest outputs that still hold several places), and yaw differences are
wrapped to (-pi, pi], so that two headings are never further apart than half a turn.

Shape letters: B states, U embedding, M components.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from nerf2real.agents.dmpo import networks
from nerf2real.agents.dmpo.config import NetworkConfig
from nerf2real.agents.dmpo.shapes import check_shapes
from nerf2real.agents.dmpo.specs import POSE_SIZE

_MIN_STDDEV = (
  0.01  # m and rad: chosen: far below the error, so that no component collapses onto a state
)


class Belief(NamedTuple):
  """A mixture of M diagonal Gaussians over x [m], y [m], yaw [rad]."""

  logits: jax.Array  # [B, M]
  means: jax.Array  # [B, M, 3]
  stddevs: jax.Array  # [B, M, 3]


def init_belief(key: jax.Array, config: NetworkConfig, embedding_size: int) -> networks.Params:
  """Returns the belief's parameters."""
  body, head = jax.random.split(key)
  outputs = config.belief_components * (1 + 2 * POSE_SIZE)
  return {
    "mlp": networks.init_mlp(body, embedding_size, config.belief_layers),
    "head": networks.init_linear(head, config.belief_layers[-1], outputs, 1.0),
  }


def predict(params: networks.Params, embedding: jax.Array) -> Belief:
  """Maps embeddings [B, U] to beliefs; no gradient flows into the embedding."""
  check_shapes(embedding=(embedding, 2))
  hidden = networks.mlp(params["mlp"], jax.lax.stop_gradient(embedding))
  raw = networks.linear(params["head"], hidden).reshape(embedding.shape[0], -1, 1 + 2 * POSE_SIZE)
  means, spread = raw[..., 1 : 1 + POSE_SIZE], raw[..., 1 + POSE_SIZE :]
  return Belief(raw[..., 0], means, jax.nn.softplus(spread) + _MIN_STDDEV)


def wrap_angle(angle: jax.Array) -> jax.Array:
  """Maps angles [rad] to (-pi, pi]."""
  return -((jnp.pi - angle) % (2 * jnp.pi) - jnp.pi)


def log_likelihood(belief: Belief, pose: jax.Array) -> jax.Array:
  """Log-density [B] of poses [B, 3] under the beliefs, with yaw's nearest turn."""
  check_shapes(pose=(pose, 2), means=(belief.means, 3))
  difference = pose[:, None, :] - belief.means
  difference = difference.at[..., 2].set(wrap_angle(difference[..., 2]))
  z = difference / belief.stddevs
  log_prob = jnp.sum(-0.5 * z**2 - jnp.log(belief.stddevs) - 0.5 * jnp.log(2 * jnp.pi), axis=-1)
  return jax.nn.logsumexp(jax.nn.log_softmax(belief.logits) + log_prob, axis=-1)


def mean_position(belief: Belief) -> jax.Array:
  """The mixture's mean x, y [B, 2] in metres."""
  share = jax.nn.softmax(belief.logits)
  return jnp.einsum("bm,bmi->bi", share, belief.means[..., :2])


def localisation_error(belief: Belief, pose: jax.Array) -> jax.Array:
  """Distance [B] in metres between the belief's mean position and the true one."""
  return jnp.linalg.norm(mean_position(belief) - pose[:, :2], axis=-1)
