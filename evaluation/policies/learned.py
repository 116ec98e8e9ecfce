"""Learned policies in an evaluation: exported networks with their belief about where they are."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.dmpo.policy.acting import Agent
from nerf2real.evaluation.plants.plant import Sight
from nerf2real.evaluation.policies.policy import Belief


class LearnedPolicy:
  """An exported policy in an evaluation."""

  control = "none"

  def __init__(self, folder: Path, *, seed: int, stochastic: bool):
    """Loads the policy.

    Args:
      folder: Of the exported policy.
      seed: Of drawn actions.
      stochastic: Whether to draw actions.

    Raises:
      ValueError: The folder holds none, or one of other observations.
    """
    self._loaded = export.load_policy(folder)
    if self._loaded.history != 1:
      raise ValueError(
        f"{folder} stacks {self._loaded.history} observations, expected 1: the suite's have a "
        "history of their own; train with history 1."
      )
    # The robot has no privileged observations, and the policy does not look at them.
    self._layout = dataclasses.replace(
      self._loaded.layout, privileged_names=(), privileged_sizes=()
    )
    self.name = folder.resolve().name
    if self.name in ("best", "newest", "policy"):
      self.name = f"{folder.resolve().parents[1 if self.name != 'policy' else 0].name}-{self.name}"
    self.policy_id = str(export.read_record(folder)["sha256"])[:12]
    shape = self._layout.image_shape
    self.image_size = None if shape is None else (shape[0], shape[1])
    self.trained_on = self._loaded.environment
    self._seed, self._stochastic = seed, stochastic
    self.belief: Belief | None = None

  def reset(self, sight: Sight, *, seed: int = 0) -> None:
    """Begins an episode; drawn actions follow from the policy's seed and that of the trial."""
    drawn = int(np.random.SeedSequence([self._seed, seed]).generate_state(1)[0])
    self._agent = Agent(
      self._loaded.policy, self._layout, seed=drawn, deterministic=not self._stochastic
    )
    self.belief = None

  def act(
    self, observation: Mapping[str, np.ndarray], *, goal: np.ndarray, sight: Sight
  ) -> np.ndarray:
    """Returns the action [20]."""
    action = self._agent.act(self._layout.flatten(observation))
    if self._loaded.policy.has_belief and self._agent.embedding.size:
      self.belief = Belief(*self._loaded.policy.belief(self._agent.embedding))
    return np.clip(action, -1.0, 1.0)
