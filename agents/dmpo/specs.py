"""The layout of an environment's observations and actions: what goes where, and how large.

Pictures (uint8 [H, W, 3]) go to the policy's image encoder; observations named `privileged/...` to
the critic alone; all others, flattened, to both. `Layout.flatten` turns a dm_env observation into
the arrays that travel and are stored.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

PRIVILEGED = "privileged/"
# Where the suite puts the robot's position [m] and rotation matrix: what the belief predicts.
POSITION = "privileged/robot_position"
ROTATION = "privileged/robot_rotation"
BALL = "privileged/ball_position"
JOINTS = "privileged/joint_positions"
POSE_SIZE = 3  # x [m], y [m], yaw [rad]


class FlatObservation(NamedTuple):
  """One observation as arrays."""

  image: np.ndarray | None  # uint8 [H, W, 3]
  state: np.ndarray  # float32 [S]
  privileged: np.ndarray  # float32 [P]


@dataclasses.dataclass(frozen=True)
class Layout:
  """Names and sizes of an environment's observations and actions."""

  image_name: str | None
  image_shape: tuple[int, int, int] | None
  state_names: tuple[str, ...]
  state_sizes: tuple[int, ...]
  privileged_names: tuple[str, ...]
  privileged_sizes: tuple[int, ...]
  action_size: int

  @property
  def state_size(self) -> int:
    """Numbers in the flattened proprioception, S."""
    return sum(self.state_sizes)

  @property
  def privileged_size(self) -> int:
    """Numbers in the flattened privileged observations, P."""
    return sum(self.privileged_sizes)

  def privileged_column(self, name: str) -> int | None:
    """Where an observation begins in the privileged vector; None if it is not there."""
    if name not in self.privileged_names:
      return None
    return sum(self.privileged_sizes[: self.privileged_names.index(name)])

  @property
  def pose_columns(self) -> tuple[int, int] | None:
    """Where position and rotation begin in the privileged vector; None if they are not there."""
    position, rotation = self.privileged_column(POSITION), self.privileged_column(ROTATION)
    return None if position is None or rotation is None else (position, rotation)

  @classmethod
  def of(cls, environment: Any) -> "Layout":
    """Reads the layout from a dm_env environment's specs.

    Raises:
      ValueError: for observations or actions that the agent cannot use.
    """
    observations, action = environment.observation_spec(), environment.action_spec()
    if not isinstance(observations, Mapping):
      raise ValueError(
        f"Observations must be a dictionary of named arrays, found {type(observations).__name__}."
      )
    images = [n for n, s in observations.items() if s.dtype == np.uint8 and len(s.shape) == 3]
    if len(images) > 1:
      raise ValueError(f"Expected at most one picture among the observations, found {images}.")
    for name in images:
      if observations[name].shape[-1] != 3 or name.startswith(PRIVILEGED):
        raise ValueError(
          f"Expected a policy picture [H, W, 3], found {name!r} {observations[name].shape}."
        )
    if len(action.shape) != 1 or not np.issubdtype(action.dtype, np.floating):
      raise ValueError(f"Expected a vector of real actions, found {action}.")
    others = [name for name in observations if name not in images]
    sizes = {name: int(np.prod(observations[name].shape, dtype=int)) for name in others}
    state = tuple(sorted(n for n in others if not n.startswith(PRIVILEGED)))
    privileged = tuple(sorted(n for n in others if n.startswith(PRIVILEGED)))
    return cls(
      image_name=images[0] if images else None,
      image_shape=tuple(observations[images[0]].shape) if images else None,
      state_names=state,
      state_sizes=tuple(sizes[n] for n in state),
      privileged_names=privileged,
      privileged_sizes=tuple(sizes[n] for n in privileged),
      action_size=int(action.shape[0]),
    )

  def flatten(self, observation: Mapping[str, Any]) -> FlatObservation:
    """Turns a dm_env observation into arrays; names that the layout lacks are ignored."""
    image = None
    if self.image_name is not None:
      image = np.asarray(observation[self.image_name])
    return FlatObservation(
      image,
      _concatenate(observation, self.state_names),
      _concatenate(observation, self.privileged_names),
    )


def _concatenate(observation: Mapping[str, Any], names: tuple[str, ...]) -> np.ndarray:
  parts = [np.ravel(np.asarray(observation[name], np.float32)) for name in names]
  return np.concatenate(parts) if parts else np.zeros(0, np.float32)


def planar_pose(privileged: Any, columns: tuple[int, int], xp: Any = np) -> Any:
  """Reads x [m], y [m] and yaw [rad] [..., 3] from privileged vectors [..., P].

  Args:
    privileged: vectors with a position [3] and a rotation matrix [9], world from body, row-major.
    columns: where the two begin, `Layout.pose_columns`.
    xp: numpy or jax.numpy.
  """
  position, rotation = columns
  yaw = xp.arctan2(privileged[..., rotation + 3], privileged[..., rotation])
  return xp.stack([privileged[..., position], privileged[..., position + 1], yaw], axis=-1)
