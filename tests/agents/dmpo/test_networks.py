"""Networks: shapes, the NumPy twin, memory, and where gradients go."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerf2real.agents.dmpo import networks, training_state
from nerf2real.agents.dmpo.config import NetworkConfig
from nerf2real.agents.dmpo.policy import inference
from nerf2real.agents.dmpo.specs import Layout

SMALL = NetworkConfig(
  policy_layers=(12, 9),
  critic_layers=(10, 8),
  image_channels=(4, 6),
  image_blocks=1,
  image_features=10,
  lstm_size=7,
  belief_layers=(6,),
)
LAYOUT = Layout("camera", (11, 14, 3), ("goal", "gyro"), (2, 5), ("privileged/v",), (4,), 3)


unroll = jax.jit(networks.unroll_policy, static_argnums=1)


def _init(config=SMALL, make=networks.init_policy):
  return jax.jit(lambda key: make(key, config, LAYOUT))(jax.random.key(0))


def _inputs(batch=2, time=5, seed=0):
  rng = np.random.default_rng(seed)
  images = rng.integers(0, 256, (batch, time, *LAYOUT.image_shape), dtype=np.uint8)
  state = rng.normal(size=(batch, time, 7)).astype(np.float32)
  initial = networks.LstmState(*rng.normal(size=(2, batch, 7)).astype(np.float32))
  return images, state, initial


def _noisy(params, seed=1):
  """Parameters away from their small first values, so that a difference would show."""
  leaves, tree = jax.tree.flatten(params)
  rng = np.random.default_rng(seed)
  return jax.tree.unflatten(
    tree, [x + 0.2 * rng.normal(size=x.shape).astype(np.float32) for x in leaves]
  )


@pytest.mark.parametrize("recurrent", [True, False])
def test_numpy_policy_agrees_with_jax(recurrent):
  config = NetworkConfig(**{**SMALL.__dict__, "recurrent": recurrent})
  params = _noisy(_init(config))
  images, state, initial = _inputs()
  expected = unroll(
    params, config, state=state, images=images / 255.0, initial=initial if recurrent else None
  )
  policy = inference.Policy(
    training_state.flatten_params({"policy": params}),
    init_stddev=config.init_stddev,
    min_stddev=config.min_stddev,
  )
  for b in range(2):
    memory = inference.PolicyState(initial.hidden[b], initial.cell[b])
    for t in range(5):
      step = policy.step(images[b, t], state[b, t], memory)
      memory = step.state
      np.testing.assert_allclose(step.mean, expected.action.mean[b, t], rtol=1e-4, atol=1e-5)
      np.testing.assert_allclose(step.stddev, expected.action.stddev[b, t], rtol=1e-4, atol=1e-5)
      np.testing.assert_allclose(step.embedding, expected.embedding[b, t], rtol=1e-4, atol=1e-5)


def test_stored_state_continues_an_episode():
  """Unrolling the second half from the state stored there equals unrolling the whole."""
  params = _noisy(_init())
  images, state, initial = _inputs(batch=1, time=6)
  whole = unroll(params, SMALL, state=state, images=images / 255.0, initial=initial)

  @jax.jit
  def state_after_three_steps(stored):
    features = networks.resnet(params["resnet"], images[0, :3] / 255.0, SMALL)
    for t in range(3):
      stored = networks.lstm_step(params["lstm"], stored, features[t][None])
    return stored

  stored = state_after_three_steps(initial)
  half = unroll(params, SMALL, state=state[:, 3:], images=images[:, 3:] / 255.0, initial=stored)
  np.testing.assert_allclose(half.action.mean, whole.action.mean[:, 3:], rtol=1e-4, atol=1e-5)
  np.testing.assert_allclose(half.embedding, whole.embedding[:, 3:], rtol=1e-4, atol=1e-5)
  forgotten = unroll(
    params,
    SMALL,
    state=state[:, 3:],
    images=images[:, 3:] / 255.0,
    initial=jax.tree.map(jnp.zeros_like, stored),
  )
  assert np.abs(forgotten.embedding - whole.embedding[:, 3:]).max() > 1e-3


def test_first_standard_deviation_and_mean():
  params = _init()
  images, state, initial = _inputs()
  out = unroll(params, SMALL, state=state, images=images / 255.0, initial=initial)
  np.testing.assert_allclose(out.action.stddev, 0.7, atol=0.02)
  np.testing.assert_allclose(out.action.mean, 0.0, atol=0.05)


def test_critic_clips_actions_and_broadcasts_samples():
  params = _noisy(_init(make=networks.init_critic))
  critic = jax.jit(networks.critic_logits)
  rng = np.random.default_rng(0)
  inputs = rng.normal(size=(2, 5, 11)).astype(np.float32)
  actions = 2 * rng.normal(size=(4, 2, 5, 3)).astype(np.float32)
  logits = critic(params, inputs, actions)
  assert logits.shape == (4, 2, 5, 51)
  clipped = critic(params, inputs, np.clip(actions, -1, 1))
  np.testing.assert_allclose(logits, clipped, rtol=1e-6)
  one = critic(params, inputs[1, 2], actions[3, 1, 2])
  np.testing.assert_allclose(logits[3, 1, 2], one, rtol=1e-4, atol=1e-5)


def test_the_critic_s_split_first_layer_is_the_whole_one():
  """W [x, a] = W_x x + W_a a, for every sampled action and for its gradients."""
  params = _noisy(_init(make=networks.init_critic))
  rng = np.random.default_rng(0)
  inputs = rng.normal(size=(2, 5, 11)).astype(np.float32)
  actions = rng.uniform(-1, 1, size=(4, 2, 5, 3)).astype(np.float32)

  def whole(params, inputs, actions):
    inputs = jnp.broadcast_to(inputs, (*actions.shape[:-1], 11))
    hidden = networks.mlp(params["mlp"], jnp.concatenate([inputs, actions], -1))
    return hidden @ params["head"]["w"] + params["head"]["b"]

  def loss(function, *arguments):
    return jnp.sum(jnp.tanh(function(*arguments)))

  for index, function in enumerate((whole, networks.critic_logits)):
    value = jax.jit(function)(params, inputs, actions)
    slopes = jax.jit(jax.grad(lambda *a, f=function: loss(f, *a), (0, 1, 2)))(
      params, inputs, actions
    )
    if index == 0:
      expected = value, slopes
  jax.tree.map(
    lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4), (value, slopes), expected
  )


def test_recurrent_policy_without_state_is_refused():
  params = _init()
  images, state, _ = _inputs()
  with pytest.raises(ValueError, match="stored LSTM state"):
    unroll(params, SMALL, state=state, images=images / 255.0, initial=None)


def test_default_policy_has_the_paper_s_shape():
  """30x40 pictures: 4x5x32 numbers leave the ResNet, an LSTM of 256 follows."""
  layout = Layout("camera", (30, 40, 3), ("s",), (160,), (), (), 20)
  shapes = jax.eval_shape(lambda: networks.init_policy(jax.random.key(0), NetworkConfig(), layout))
  assert shapes["resnet"]["linear"]["w"].shape == (4 * 5 * 32, 256)
  assert shapes["lstm"]["w"].shape == (512, 1024)
  assert shapes["mlp"]["layer0"]["w"].shape == (256 + 160, 256)
