"""An environment whose task knows success, and a link that grants all and keeps what it got."""

import re
import types
from pathlib import Path

import dm_env
import numpy as np
from dm_env import specs

from nerf2real.agents.dmpo import config, learning, networks, presets, training_state
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.link.client import Grant
from nerf2real.core.serialization import from_plain, to_plain

SMALL = {"network.policy_layers": (8,), "network.critic_layers": (8,), "num_samples": 2}


class Reach(dm_env.Environment):
  """Succeeds at the second step of a trial that says so; without one by the toss of a coin."""

  def __init__(self, seed=0):
    self.random_state = np.random.RandomState(seed)
    self.task = types.SimpleNamespace(
      success=False, standing_action=np.full(2, 0.25), set_trial=self._set_trial
    )
    self.fail_at = set()  # numbers of episodes whose reset raises
    self.episodes = 0
    self.seen = []  # trials that were set up
    self._trial = None

  def _set_trial(self, trial):
    self._trial = trial
    self.seen.append(trial)

  def reset(self):
    self.episodes += 1
    if self.episodes in self.fail_at:
      raise ValueError("There is no place left.")
    self.task.success, self._step = False, 0
    self._wins = self._trial.wins if self._trial else self.random_state.rand() < 0.5
    return dm_env.restart(self._observe())

  def step(self, action):
    self._step += 1
    self.task.success = self.task.success or (self._wins and self._step == 2)
    if self._step == 4:
      return dm_env.termination(1.0, self._observe())
    return dm_env.transition(1.0, self._observe())

  def _observe(self):
    return {"s": self.random_state.rand(3).astype(np.float32)}

  def observation_spec(self):
    return {"s": specs.Array((3,), np.float32, "s")}

  def action_spec(self):
    return specs.BoundedArray((2,), np.float32, -1.0, 1.0, "action")


def description(environment, name, **changes):
  """What a learner tells its actors of a run on an environment."""
  settings = config.override(presets.preset("state"), SMALL)
  return {
    "environment": name,
    "evaluation_environment": name,
    "config": to_plain(settings),
    "layout": to_plain(Layout.of(environment)),
    "seed": 0,
    "begin_steps": 0,
    "evaluation_period": 100,
    "evaluation_episodes": None,
  } | changes


def documented(source):
  """Names in the README's table of what a source logs."""
  readme = (Path(config.__file__).parent / "README.md").read_text()
  table = readme.partition(f"| {source} | |\n")[2].partition("\n\n")[0]
  cells = [line.split("|")[1] for line in table.splitlines()[1:]]
  return {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}


class StubLink:
  """A learner that is always there; `process.stop()` is called after `limit` trajectories."""

  def __init__(self, description, *, limit=10, predecessors=0):
    self._description, self._limit, self._predecessors = description, limit, predecessors
    self.version = 0
    self.status_values = {}
    self.sent, self.reports = [], []
    self.process = None

  def status(self):
    return {
      "status": self.status_values,
      "description": self._description,
      "predecessors": self._predecessors,
    }

  def parameters(self, *, hold=False):
    settings = from_plain(self._description["config"], config.DmpoConfig)
    layout = from_plain(self._description["layout"], Layout)
    state = learning.make_learning(settings, layout).init(networks.jax.random.PRNGKey(0))
    return 0, training_state.served_parameters(state)

  def request(self, wanted, *, held=0):
    values = {"granted": wanted, "version": 0, "stop": False, "ending": False, "steps": 0}
    return Grant(values)

  def send(self, trajectory, *, steps):
    self.sent.append(trajectory)
    if len(self.sent) >= self._limit:
      self.process.stop()

  def report(self, values):
    self.reports.append(dict(values))

  def flush(self):
    pass

  def drain(self, *, timeout):
    return True
