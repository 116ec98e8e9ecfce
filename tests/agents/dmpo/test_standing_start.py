"""Nightly: a policy that begins at the standing action with little noise learns a control task."""

import types

import dm_env
import jax
import numpy as np
import pytest
from dm_env import specs

from nerf2real.agents.dmpo import config, learning, presets, scaling, training_state
from nerf2real.agents.dmpo.policy import acting, inference
from nerf2real.agents.dmpo.replay.ring import Replay, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout

STANDING = 0.3  # the action that moves nothing
SETTINGS = config.override(
  presets.preset("op3_small"),
  {
    "network.policy_layers": (64, 64),
    "network.critic_layers": (64, 64),
    "network.vmin": -20.0,
    "network.vmax": 20.0,
    "policy_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "discount": 0.9,
    "trajectory_length": 11,
    "target_critic_period": 25,
  },
)
FILL, STEPS, EPISODE = 1_000, 9_000, 20


class Follow(dm_env.Environment):
  """Move to a target: x += 0.3 (a - 0.3), reward 1 - |x - target|; readings in unlike units."""

  def __init__(self, seed):
    self._random = np.random.default_rng(seed)
    self.task = types.SimpleNamespace(standing_action=np.array([STANDING], np.float32))

  def reset(self):
    self._x, self._target = 0.0, self._random.uniform(-1, 1)
    self._step = 0
    return dm_env.restart(self._observe())

  def step(self, action):
    self._x += 0.3 * (float(np.clip(action[0], -1, 1)) - STANDING)
    self._step += 1
    reward = 1.0 - abs(self._x - self._target)
    if self._step == EPISODE:
      return dm_env.truncation(reward, self._observe())
    return dm_env.transition(reward, self._observe())

  def _observe(self):
    error = self._target - self._x
    return {
      "gravity": np.array([9.81, 0.0], np.float32) + self._random.normal(size=2).astype("f"),
      "error": np.array([0.05 * error], np.float32),
    }

  def observation_spec(self):
    return {
      "gravity": specs.Array((2,), np.float32, "gravity"),
      "error": specs.Array((1,), np.float32, "error"),
    }

  def action_spec(self):
    return specs.BoundedArray((1,), np.float32, -1.0, 1.0, "action")


def _policy(state):
  network = SETTINGS.network
  return inference.Policy(
    training_state.served_parameters(state), init_stddev=network.init_stddev, min_stddev=1e-6
  )


def _evaluate(state, layout, episodes=40):
  agent = acting.Agent(_policy(state), layout, seed=0, deterministic=True)
  environment = Follow(seed=99)
  return np.mean([acting.run_episode(agent, environment)["return"] for _ in range(episodes)])


def _train(state, functions, layout):
  environment, steps, updates = Follow(seed=1), 0, 0
  replay = Replay(
    trajectory_fields(layout, lstm_size=0), length=SETTINGS.trajectory_length, capacity_steps=20_000
  )
  agent = acting.Agent(_policy(state), layout, seed=2)
  builder = acting.TrajectoryBuilder(SETTINGS.trajectory_length)
  rng = np.random.default_rng(3)
  while steps < STEPS:
    timestep = environment.reset()
    agent.reset()
    observation = layout.flatten(timestep.observation)
    builder.start(observation, agent.state)
    while not timestep.last():
      action = agent.act(observation)
      timestep = environment.step(action)
      observation = layout.flatten(timestep.observation)
      last = timestep.last()
      added = {"observation": observation, "state": agent.state, "last": last}
      trajectory = builder.add(action, timestep.reward, timestep.discount, **added)
      steps += 1
      if trajectory:
        replay.insert(trajectory)
    if steps == FILL:
      rows = replay.sample(rng, 200, names=scaling.NAMES)
      rows = {name: np.concatenate(values) for name, values in rows.items()}
      scales = scaling.measure(rows, layout)
      state = training_state.with_scaling(state, scales, keep_policy=False)
    while updates * 4 < steps - FILL:
      state, _ = functions.update(state, replay.sample(rng, SETTINGS.batch_size))
      updates += 1
    agent.policy.update(training_state.served_parameters(state))
  return state


@pytest.mark.slow
def test_it_learns_from_a_standing_start_with_little_noise():
  layout = Layout.of(Follow(seed=0))
  first_action = Follow(seed=0).task.standing_action
  functions = learning.make_learning(SETTINGS, layout, first_action=first_action)
  state = jax.jit(functions.init)(jax.random.PRNGKey(0))
  before = _evaluate(state, layout)
  assert before == pytest.approx(10.0, abs=1.5)  # it stands still: |target| is 0.5 on average
  after = _evaluate(_train(state, functions, layout), layout)
  # Full speed is 0.39 a step one way, 0.21 the other: the best loses 1 or 2 of 20 on the way.
  assert after > 15.0, (before, after)
