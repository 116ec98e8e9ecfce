"""The protocol of policies in an evaluation, and the scripted walker as one."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from nerf2real.core.serialization import to_plain
from nerf2real.evaluation.plants.plant import Sight
from nerf2real.suite.gaits.walk import GaitSettings
from nerf2real.suite.gaits.walker import SteeringSettings, Walker
from nerf2real.suite.op3 import constants
from nerf2real.suite.protocols import BALL


class Belief(NamedTuple):
  """A mixture of M Gaussians over x [m], y [m], yaw [rad]."""

  logits: np.ndarray  # [M]
  means: np.ndarray  # [M, 3]
  stddevs: np.ndarray  # [M, 3]

  @property
  def position(self) -> np.ndarray:
    """Mean x, y [2] [m]."""
    share = np.exp(self.logits - self.logits.max())
    return (share / share.sum()) @ self.means[:, :2]


class EvaluatedPolicy(Protocol):
  """A policy in an evaluation."""

  name: str
  policy_id: str  # digest of what it is made of
  image_size: tuple[int, int] | None  # of the pictures that it needs
  control: str  # one of `controls.CONTROLS`; "none": its observations are the plant's
  trained_on: str  # name of its environment; empty for a policy that was not trained

  def reset(self, sight: Sight, *, seed: int = 0) -> None:
    """Begins an episode, at what is seen of the robot; the seed is of its trial's drawn actions."""

  def act(
    self, observation: Mapping[str, np.ndarray], *, goal: np.ndarray, sight: Sight
  ) -> np.ndarray:
    """Returns the action [20]; learned policies look at the observation alone."""

  @property
  def belief(self) -> Belief | None:
    """The believed position since the last action; None for a policy without a belief."""


def resolution(policy: EvaluatedPolicy) -> str:
  """Returns the paper's name of a policy's resolution."""
  size = policy.image_size
  return "no camera" if size is None else f"{size[0]} x {size[1]}"


class GaitPolicy:
  """The scripted walker, with the observed pose or by dead reckoning without one."""

  name = "gait"
  image_size: tuple[int, int] | None = None
  control = "none"
  trained_on = ""
  belief: Belief | None = None

  def __init__(
    self,
    scene: Any,
    protocol: str,
    *,
    settings: GaitSettings | None = None,
    steering: SteeringSettings | None = None,
  ):
    """Creates the policy.

    Args:
      scene: An opened bundle.
      protocol: One of `protocols.PROTOCOLS`.
      settings: Parameters of the gait.
      steering: And of its steering.
    """
    head_pan = constants.BALL_PUSHING_HEAD_PAN if protocol == BALL else None
    self._walker = Walker(scene, gait=settings, steering=steering, head_pan_limit=head_pan)
    made_of: Any = settings or GaitSettings()
    if steering is not None:
      made_of = [made_of, steering]
    text = json.dumps(to_plain(made_of), sort_keys=True)
    self.policy_id = hashlib.sha256(text.encode()).hexdigest()[:12]

  def reset(self, sight: Sight, *, seed: int = 0) -> None:
    if sight.pose is None:
      raise ValueError("The gait must know where it starts: place the robot at the trial's start.")
    self._walker.reset(sight.pose)

  def act(
    self, observation: Mapping[str, np.ndarray], *, goal: np.ndarray, sight: Sight
  ) -> np.ndarray:
    return self._walker.act(observation, goal=goal, pose=sight.pose, ball=sight.ball)
