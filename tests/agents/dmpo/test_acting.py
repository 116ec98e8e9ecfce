"""Trajectories, environments by name, export and loading."""

import json
import subprocess
import sys
from pathlib import Path

import dm_env
import jax
import numpy as np
import pytest
from dm_env import specs

from nerf2real.agents.dmpo import config, networks, presets, training_state
from nerf2real.agents.dmpo.policy import acting, export, inference
from nerf2real.agents.dmpo.replay.ring import check_trajectory, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments import loading
from nerf2real.core.serialization import to_plain

PRESET = config.override(presets.preset("vision_small"), {"network.lstm_size": 8})


def _exported(folder, environment_name="agents:cue"):
  environment = loading.make_environment(environment_name, seed=0)
  layout = Layout.of(environment)
  params = jax.jit(lambda key: networks.init_policy(key, PRESET.network, layout))(jax.random.key(0))
  export.export_policy(
    folder,
    training_state.flatten_params({"policy": params}),
    layout=layout,
    environment=environment_name,
    settings=to_plain(PRESET),
    info={"updates": 3},
  )
  return environment, layout


@pytest.fixture(scope="module")
def cue(tmp_path_factory):
  folder = tmp_path_factory.mktemp("policy")
  return folder, *_exported(folder)


def test_every_transition_once_and_states_where_they_belong(cue):
  folder, environment, layout = cue
  loaded = export.load_policy(folder)
  assert loaded.layout == layout and loaded.info == {"updates": 3}
  agent = acting.Agent(loaded.policy, layout, seed=0)
  builder = acting.TrajectoryBuilder(length=10)
  trajectories, rewards, states = [], [], []
  timestep = environment.reset()
  agent.reset()
  observation = layout.flatten(timestep.observation)
  builder.start(observation, agent.state)
  while not timestep.last():
    states.append(agent.state.hidden)
    action = agent.act(observation)
    timestep = environment.step(action)
    observation = layout.flatten(timestep.observation)
    rewards.append(timestep.reward)
    trajectory = builder.add(
      action,
      timestep.reward,
      timestep.discount,
      observation=observation,
      state=agent.state,
      last=timestep.last(),
    )
    if trajectory:
      trajectories.append(trajectory)
  fields = trajectory_fields(layout, lstm_size=8)
  assert [check_trajectory(t, fields, length=10) for t in trajectories] == [10, 10, 7]
  stored = np.concatenate([t["reward"][:-1] for t in trajectories])
  np.testing.assert_allclose(stored, rewards, rtol=1e-6)
  for trajectory, start in zip(trajectories, [0, 9, 18], strict=True):
    np.testing.assert_array_equal(trajectory["lstm_hidden"], states[start])
  np.testing.assert_array_equal(trajectories[0]["image"][-1], trajectories[1]["image"][0])
  assert trajectories[-1]["discount"][-2] == 0  # the task terminates
  assert builder.finish() is None


def test_exported_policy_needs_neither_jax_nor_the_simulator(cue):
  code = (
    "import sys, numpy as np\n"
    "from nerf2real.agents.dmpo.policy.export import load_policy\n"
    f"p = load_policy({str(cue[0])!r}).policy\n"
    "step = p.step(np.zeros((30, 40, 3), np.uint8), np.zeros(1, np.float32), p.initial_state())\n"
    "assert np.isfinite(step.mean).all()\n"
    "bad = {'jax', 'optax', 'orbax', 'flax', 'mujoco', 'dm_control', 'zenoh'} & set(sys.modules)\n"
    "assert not bad, bad\n"
  )
  subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_the_readme_s_example_runs(cue):
  folder, environment, layout = cue
  readme = (Path(acting.__file__).parents[1] / "README.md").read_text()
  code = readme.partition("```python\n")[2].partition("```")[0]
  code = code.replace("runs/nav/policy/best", str(folder))
  scope = {"observation": environment.reset().observation}
  exec(code, scope)
  assert scope["step"].mean.shape == (layout.action_size,)


def test_damaged_or_missing_policy_is_refused(tmp_path):
  with pytest.raises(ValueError, match="holds no policy"):
    export.load_policy(tmp_path)
  _exported(tmp_path)
  with (tmp_path / "policy.npz").open("r+b") as stream:
    stream.seek(200)
    stream.write(b"xxxx")
  with pytest.raises(ValueError, match="arrays are not those"):
    export.load_policy(tmp_path)
  (tmp_path / "policy.npz").unlink()
  with pytest.raises(ValueError, match="holds no policy.npz beside its policy.json"):
    export.load_policy(tmp_path)


@pytest.mark.parametrize(
  ("content", "message"),
  [
    ("{", "policy.json is damaged"),
    ("[]", "is of format None, expected 1"),
    ('{"format_version": 0}', "is of format 0, expected 1"),
    ('{"format_version": 1}', "lacks environment, layout, settings, info, sha256"),
  ],
)
def test_a_record_that_is_none_is_refused(tmp_path, content, message):
  (tmp_path / "policy.json").write_text(content)
  with pytest.raises(ValueError, match=message):
    export.load_policy(tmp_path)


def test_settings_of_another_agent_are_refused(tmp_path):
  _exported(tmp_path)
  record = export.read_record(tmp_path) | {"settings": {"nothing": 1}}
  (tmp_path / "policy.json").write_text(json.dumps(record))
  with pytest.raises(ValueError, match="other settings than an agent's \\('network'\\)"):
    export.load_policy(tmp_path)


def test_cue_needs_memory():
  """The best policy with memory gets 22; the mean action of any memoryless one gets 0."""
  environment = loading.make_environment("agents:cue", seed=0)

  def run(act):
    total = 0.0
    for _ in range(200):
      timestep, side = environment.reset(), None
      while not timestep.last():
        image = timestep.observation["camera"].astype(int)
        red = image[..., 0] - image[..., 2] > 80
        if red.sum() > 50:  # more than noise makes
          side = -1 if red[:, :20].sum() > 50 else 1
        timestep = environment.step(np.array([act(side)]))
        total += timestep.reward
    return total / 200

  assert run(lambda side: side) == 22
  assert abs(run(lambda side: 1.0)) < 22 * 4 / np.sqrt(200)


def test_dm_control_by_name_with_canonical_actions_and_history():
  environment = loading.make_environment("dm_control:cartpole:swingup", seed=1, history=3)
  layout = Layout.of(environment)
  assert layout.image_name is None and layout.state_size == 3 * 5 and layout.action_size == 1
  first = layout.flatten(environment.reset().observation).state.reshape(-1)
  assert np.isfinite(first).all()
  timestep = environment.step(np.array([5.0]))  # clipped, not an error
  position = timestep.observation["position"]
  assert position.shape[0] == 3
  np.testing.assert_array_equal(position[0], position[1])
  assert np.abs(position[2] - position[1]).max() > 0


def test_a_spec_scales_actions():
  class Wide(dm_env.Environment):
    def reset(self):
      return dm_env.restart({})

    def step(self, action):
      return dm_env.transition(0.0, {"seen": action})

    def observation_spec(self):
      return {}

    def action_spec(self):
      return specs.BoundedArray((2,), np.float64, [-2, 0], [4, 1])

  seen = loading.Canonical(Wide()).step(np.array([0.0, -9.0])).observation["seen"]
  np.testing.assert_allclose(seen, [1.0, 0.0])


@pytest.mark.parametrize(
  ("name", "message"),
  [
    ("gym:cartpole", "Unknown environment"),
    ("dm_control:cartpole:fly", "no task"),
    ("agents:cue?speed=3", "Unknown options"),
  ],
)
def test_unknown_names_are_refused(name, message):
  with pytest.raises(ValueError, match=message):
    loading.make_environment(name, seed=0)


def test_belief_error_is_measured(cue):
  policy = export.load_policy(cue[0]).policy
  rng = np.random.default_rng(0)
  parameters = {
    "policy/mlp/layer0/w": rng.normal(size=(2, 4)).astype(np.float32),
    "belief/mlp/layer0/w": np.zeros((0, 4), np.float32),
  }
  zeros = lambda *shape: np.zeros(shape, np.float32)  # noqa: E731
  parameters |= {f"policy/mlp/{k}": zeros(4) for k in ("layer0/b", "norm_scale", "norm_bias")}
  parameters |= {f"belief/mlp/{k}": zeros(4) for k in ("layer0/b", "norm_scale", "norm_bias")}
  for head in ("mean", "stddev"):
    parameters |= {f"policy/{head}/w": zeros(4, 1), f"policy/{head}/b": zeros(1)}
  bias = zeros(7)
  bias[1:3] = 3.0, 4.0
  parameters |= {"belief/head/w": zeros(4, 7), "belief/head/b": bias}
  policy = inference.Policy(parameters, init_stddev=0.7, min_stddev=1e-6)
  layout = Layout(
    None, None, ("s",), (2,), ("privileged/robot_position", "privileged/robot_rotation"), (3, 9), 1
  )
  agent = acting.Agent(policy, layout, seed=0)
  observation = layout.flatten(
    {"s": zeros(2), "privileged/robot_position": zeros(3), "privileged/robot_rotation": np.eye(3)}
  )
  agent.act(observation)
  assert agent.errors == [5.0]
