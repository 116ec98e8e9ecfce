"""Control experiments: what a policy that uses its camera and its goal must not pass.

A policy that reaches goals on black pictures finds its way without seeing; one that reaches the
trial's goal when it is given another one does not use the goal. Plant, trials and what counts as a
success are unchanged.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from nerf2real.evaluation.plants.plant import Sight
from nerf2real.evaluation.policies.policy import Belief, EvaluatedPolicy
from nerf2real.suite.protocols import BALL

NONE, BLACK, OTHER_GOAL = "none", "black", "other_goal"
CONTROLS = (NONE, BLACK, OTHER_GOAL)


class ControlledPolicy:
  """A policy whose observations are falsified."""

  def __init__(self, policy: EvaluatedPolicy, *, control: str, goals: np.ndarray):
    """Wraps a policy.

    Args:
      policy: What acts.
      control: BLACK: pictures are zero; OTHER_GOAL: the goal is another one of the scene's.
      goals: The scene's [G, 2] [m].
    """
    self.name, self.policy_id, self.image_size = policy.name, policy.policy_id, policy.image_size
    self.control, self.trained_on = control, policy.trained_on
    self._policy, self._goals = policy, goals

  @property
  def belief(self) -> Belief | None:
    """Of the policy."""
    return self._policy.belief

  def reset(self, sight: Sight, *, seed: int = 0) -> None:
    self._policy.reset(sight, seed=seed)

  def act(
    self, observation: Mapping[str, np.ndarray], *, goal: np.ndarray, sight: Sight
  ) -> np.ndarray:
    if self.control == BLACK:
      dark = {n: np.zeros_like(a) if n == "camera" else a for n, a in observation.items()}
      return self._policy.act(dark, goal=goal, sight=sight)
    other = other_goal(self._goals, goal)
    shown = {**observation, "goal": other.astype(np.float32)}
    return self._policy.act(shown, goal=other, sight=sight)


def other_goal(goals: np.ndarray, goal: np.ndarray) -> np.ndarray:
  """Returns the goal [2] that follows a goal [2] in a scene's list [G, 2]."""
  present = int(np.argmin(np.linalg.norm(goals - goal, axis=1)))
  return np.asarray(goals[(present + 1) % len(goals)], np.float64)


def under_control(
  policy: EvaluatedPolicy, control: str, *, scene: Any, protocol: str
) -> EvaluatedPolicy:
  """Returns a policy as a control experiment runs it.

  Args:
    policy: The policy.
    control: One of CONTROLS.
    scene: The bundle, for its goals.
    protocol: One of `protocols.PROTOCOLS`.

  Raises:
    ValueError: There is nothing to falsify.
  """
  if control == NONE:
    return policy
  if control not in CONTROLS:
    raise ValueError(f"Unknown control {control!r}: expected one of {', '.join(CONTROLS)}.")
  goals = np.asarray(scene.goals, np.float64).reshape(-1, 2)
  if control == BLACK and policy.image_size is None:
    raise ValueError(f"{policy.name} looks at no pictures: expected one that does for {BLACK!r}.")
  if control == OTHER_GOAL and (protocol == BALL or len(goals) < 2):
    raise ValueError(
      f"Found no other goal in the protocol {protocol!r} of {len(goals)} goals: run navigation in "
      "a scene with two or more."
    )
  return ControlledPolicy(policy, control=control, goals=goals)
