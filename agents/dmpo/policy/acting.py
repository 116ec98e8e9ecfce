"""Acting: an agent that steps its policy, and trajectories made from its observations.

A trajectory has up to T observations. Its last one only bootstraps, and is the first one of the
next trajectory of the same episode, so that every transition is stored exactly once. The LSTM's
state before the first observation is stored with it.
"""

from typing import Any

import dm_env
import numpy as np

from nerf2real.agents.dmpo.policy.inference import Policy, PolicyState
from nerf2real.agents.dmpo.specs import FlatObservation, Layout, planar_pose

Trajectory = dict[str, np.ndarray]


class TrajectoryBuilder:
  """Collects steps into trajectories of at most `length` observations."""

  def __init__(self, length: int):
    self._length = length
    self._observations: list[FlatObservation] = []
    self._steps: list[tuple[np.ndarray, float, float]] = []
    self._initial: PolicyState | None = None

  @property
  def steps(self) -> int:
    """Transitions collected and not given out."""
    return len(self._steps)

  def start(self, observation: FlatObservation, state: PolicyState) -> None:
    """Begins an episode; what was not given out is dropped.

    Args:
      observation: the first one.
      state: the policy's state before it.
    """
    self._observations, self._steps = [observation], []
    self._initial = state

  def add(
    self,
    action: np.ndarray,
    reward: float,
    discount: float,
    *,
    observation: FlatObservation,
    state: PolicyState,
    last: bool,
  ) -> Trajectory | None:
    """Adds a transition; returns a trajectory when one is full or the episode ends.

    Args:
      action: as the policy drew it, not clipped [A].
      reward: what followed.
      discount: the environment's, 0 where the episode terminates.
      observation: what was seen next.
      state: the policy's state before that observation.
      last: whether the episode ends with it.
    """
    self._steps.append((action, reward, discount))
    self._observations.append(observation)
    if not last and len(self._observations) < self._length:
      return None
    trajectory = self.finish()
    self.start(observation, state)
    return trajectory

  def finish(self) -> Trajectory | None:
    """Returns the transitions collected so far as a trajectory; None if there are none."""
    if not self._steps or self._initial is None:
      return None
    actions, rewards, discounts = zip(*self._steps, strict=True)
    first = self._observations[0]
    trajectory = {
      "state": np.stack([o.state for o in self._observations]),
      "privileged": np.stack([o.privileged for o in self._observations]),
      "action": np.stack([*actions, np.zeros_like(actions[0])]).astype(np.float32),
      "reward": np.array([*rewards, 0.0], np.float32),
      "discount": np.array([*discounts, 0.0], np.float32),
    }
    if first.image is not None:
      trajectory["image"] = np.stack([o.image for o in self._observations if o.image is not None])
    if self._initial.hidden.size:
      trajectory["lstm_hidden"], trajectory["lstm_cell"] = self._initial
    self._observations, self._steps = [self._observations[-1]], []
    return trajectory


class Agent:
  """A policy in an episode: keeps the recurrent state and measures the belief's error."""

  def __init__(self, policy: Policy, layout: Layout, *, seed: int, deterministic: bool = False):
    """Creates an agent.

    Args:
      policy: the policy.
      layout: the environment's layout.
      seed: of the actions drawn.
      deterministic: takes the policy's mean instead of drawing.
    """
    self.policy = policy
    self.layout = layout
    self._random = np.random.default_rng(seed)
    self._deterministic = deterministic
    self.state = policy.initial_state()
    self.embedding = np.zeros(0, np.float32)  # of the last step, for the belief [U]
    self.errors: list[float] = []  # the belief's distance from the truth in this episode [m]

  def reset(self) -> None:
    """Begins an episode."""
    self.state = self.policy.initial_state()
    self.errors = []

  def act(self, observation: FlatObservation) -> np.ndarray:
    """Returns an action [A], not clipped, and moves the recurrent state on."""
    step = self.policy.step(observation.image, observation.state, self.state)
    self.state, self.embedding = step.state, step.embedding
    self._measure(observation)
    if self._deterministic:
      return step.mean
    noise = self._random.standard_normal(step.mean.shape, dtype=np.float32)
    return step.mean + step.stddev * noise

  def _measure(self, observation: FlatObservation) -> None:
    columns = self.layout.pose_columns
    if columns is None or not self.policy.has_belief or not observation.privileged.size:
      return
    truth = planar_pose(observation.privileged, columns)[:2]
    believed = self.policy.believed_position(self.embedding)
    self.errors.append(float(np.linalg.norm(believed - truth)))


def run_episode(agent: Agent, environment: dm_env.Environment) -> dict[str, Any]:
  """Runs an episode and returns its figures: return, length, success and localisation error."""
  timestep = environment.reset()
  agent.reset()
  total, steps, success = 0.0, 0, None
  while not timestep.last():
    timestep = environment.step(agent.act(agent.layout.flatten(timestep.observation)))
    total += float(timestep.reward or 0.0)
    steps += 1
    success = episode_success(environment)
  return episode_figures(agent, total=total, steps=steps, success=success)


def episode_figures(
  agent: Agent, *, total: float, steps: int, success: bool | None
) -> dict[str, Any]:
  """Figures of one episode, without those that the environment does not give."""
  figures: dict[str, Any] = {"return": total, "steps": steps}
  if success is not None:
    figures["success"] = float(success)
  if agent.errors:
    figures["localisation_error"] = float(np.mean(agent.errors))
  return figures


def task_of(environment: Any) -> Any:
  """The task below the wrappers of an environment; None if it has none."""
  while hasattr(environment, "_environment"):
    environment = environment._environment
  return getattr(environment, "task", None)


def episode_success(environment: Any) -> bool | None:
  """Whether the task's goal was reached in this episode; None for a task without success."""
  success = getattr(task_of(environment), "success", None)
  return None if success is None else bool(success() if callable(success) else success)
