"""Chooses the driver of an environment that is shown (viewer, film) by a policy's name."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nerf2real.agents.dmpo.policy import belief_plot
from nerf2real.agents.environments.loading import camera_settings
from nerf2real.core.floor_map import Extent
from nerf2real.evaluation.plants.plant import Sight
from nerf2real.evaluation.policies.learned import LearnedPolicy
from nerf2real.evaluation.policies.names import WALKERS, policy_folder
from nerf2real.evaluation.policies.policy import Belief
from nerf2real.suite.views.drivers import SCRIPTED, WALKER, MakeDriver


def density(belief: Belief | None, extent: Extent) -> np.ndarray | None:
  """Returns a belief's density [1/m^2] over an extent as `FloorMap.heat`; None without a belief."""
  return None if belief is None else belief_plot.position_density(*belief, extent=extent)


class LearnedDriver:
  """A learned policy in an environment of the suite."""

  def __init__(self, task: Any, policy: LearnedPolicy):
    """Takes a task of the suite."""
    self._task, self._policy = task, policy

  def _sight(self) -> Sight:
    return Sight(self._task.state.pose, None, collided=False, fallen=False)

  def restart(self) -> None:
    self._policy.reset(self._sight())

  def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    return self._policy.act(observation, goal=np.zeros(2), sight=self._sight())

  def density(self, extent: Extent) -> np.ndarray | None:
    return density(self._policy.belief, extent)


class Chosen(NamedTuple):
  """A policy by name, for environments that are shown."""

  name: str
  make: MakeDriver
  image_size: tuple[int, int] | None  # of the pictures that it needs; None: of any size
  camera: Any = None  # the `CameraSettings` that it was trained with; None: the suite's own


def choose_driver(name: str, *, task: str, seed: int = 0) -> Chosen:
  """Returns a driver by its name.

  Args:
    name: "walker", "stand", "random", "shipped", or a folder; see `names`.
    task: The task.
    seed: Of drawn actions.

  Raises:
    ValueError: There is no such policy.
    OSError: The file of the lens that it was trained with cannot be read.
  """
  if name in WALKERS:
    name = WALKER
  if name in SCRIPTED:
    return Chosen(name, SCRIPTED[name], None)
  folder: Path = policy_folder(name, task=task)
  policy = LearnedPolicy(folder, seed=seed, stochastic=False)
  return Chosen(
    policy.name,
    lambda built: LearnedDriver(built, policy),
    policy.image_size,
    camera_settings(policy.trained_on),
  )
