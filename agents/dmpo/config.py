"""Settings of the agent. The defaults are the paper's table of DMPO hyperparameters.

Sources named below. Paper: Byravan et al. 2022, NeRF2Real, appendix, table "List of DMPO
hyperparameters" (or the place named). Reference: the public DMPO of Acme (Hoffman et al. 2020).
IMPALA: Espeholt et al. 2018, figure 3. Chosen: left open by the paper; the reason is given.
A unit is given where there is one; everything else is a pure number.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from nerf2real.core.serialization import from_plain, to_plain

ZERO, STANDING = "zero", "standing"
FIRST_ACTIONS = (ZERO, STANDING)
_COUNTS = (
  "batch_size",
  "n_step",
  "num_samples",
  "target_actor_period",
  "target_critic_period",
  "feature_copies",
  "history",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class NetworkConfig:
  """Shapes of the policy, the critic and the belief."""

  policy_layers: tuple[int, ...] = (256, 256, 256)
  """Widths of the policy's MLP [units]. Source: reference, control suite."""
  critic_layers: tuple[int, ...] = (512, 512, 256)
  """Widths of the critic's MLP [units]. Source: reference."""
  image_channels: tuple[int, ...] = (16, 32, 32)
  """Channels of the ResNet's sections, each halving the picture. Source: IMPALA."""
  image_blocks: int = 2
  """Residual blocks in a section. Source: IMPALA."""
  image_features: int = 256
  """Width of the layer between ResNet and LSTM [units]. Source: IMPALA."""
  recurrent: bool = True
  """Whether an LSTM follows the image features. Source: paper, "Policy training"."""
  lstm_size: int = 256
  """Units of the LSTM. Source: IMPALA; the paper gives no number."""
  init_stddev: float = 0.7
  """The policy's standard deviation at the start [actions]. Source: reference."""
  min_stddev: float = 1e-6
  """Smallest standard deviation [actions]. Source: reference."""
  policy_head_scale: float = 1e-4
  """Variance scale of the policy heads' first weights. Source: reference."""
  critic_head_scale: float = 1e-5
  """Variance scale of the critic head's first weights. Source: reference."""
  num_atoms: int = 51
  """Atoms of the value distribution. Source: reference and Bellemare et al. 2017."""
  vmin: float = -150.0
  """Smallest value represented [reward]. Source: paper."""
  vmax: float = 150.0
  """Largest value represented [reward]. Source: paper."""
  belief_layers: tuple[int, ...] = (256, 256)
  """Widths of the belief's MLP [units]. Source: chosen; the paper says "MLP"."""
  belief_components: int = 5
  """Gaussians in the belief's mixture. Source: paper, "Navigation ... results"."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AugmentationConfig:
  """Random changes of the pictures; one draw serves a whole trajectory."""

  enabled: bool = True
  """Whether pictures are augmented in training. Source: paper, "Policy training"."""
  brightness: float = 32.0 / 255.0
  """Largest change of brightness, of 1. Source: paper, table "Image augmentation"."""
  hue: float = 1.0 / 24.0
  """Largest turn of the hue, of a full turn. Source: paper, same table."""
  contrast: tuple[float, float] = (0.5, 1.5)
  """Range of the factor on contrast. Source: paper, same table."""
  saturation: tuple[float, float] = (0.5, 1.5)
  """Range of the factor on saturation. Source: paper, same table."""
  translation: float = 0.05
  """Largest shift, of the picture's height and width. Source: paper, "Camera calibration"."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DmpoConfig:
  """The agent's settings; the defaults are the paper's."""

  network: NetworkConfig = NetworkConfig()
  """Shapes of the networks."""
  augmentation: AugmentationConfig = AugmentationConfig()
  """Random changes of the pictures."""

  policy_learning_rate: float = 1e-4
  """Adam's step for the policy, and for the belief. Source: paper."""
  critic_learning_rate: float = 1e-4
  """Adam's step for the critic. Source: paper."""
  dual_learning_rate: float = 1e-2
  """Adam's step for temperatures and KL multipliers. Source: paper."""
  max_gradient_norm: float = 40.0
  """Clip of the global norm, policy and critic each by itself. Source: reference."""
  trajectory_length: int = 48
  """Observations in a trajectory [steps]; the last one only bootstraps. Source: paper."""
  batch_size: int = 32
  """Trajectories in an update. Source: paper."""
  steps_per_update: float = 8.0
  """Environment steps that pay for one update [steps]. Source: paper (updates per step 1/8)."""
  discount: float = 0.99
  """Discount for one control step. Source: paper."""
  n_step: int = 5
  """Rewards summed before bootstrapping [steps]. Source: paper."""
  num_samples: int = 20
  """Actions sampled at each state. Source: reference."""

  epsilon: float = 0.1
  """Bound on the E-step's KL [nat]. Source: paper."""
  epsilon_mean: float = 0.0025
  """Bound on the mean's KL, for each action dimension [nat]. Source: paper."""
  epsilon_stddev: float = 1e-6
  """Bound on the standard deviation's KL, for each action dimension [nat]. Source: paper."""
  epsilon_action_penalty: float = 0.001
  """Bound on the KL of the out-of-bounds objective [nat]. Source: paper."""
  action_penalization: bool = True
  """Whether actions outside [-1, 1] are penalised. Source: paper."""
  per_dimension_kl: bool = True
  """Whether every action dimension has its own KL bound. Source: paper."""
  init_log_temperature: float = 10.0
  """First raw value of both temperatures. Source: paper; the penalty's: reference."""
  init_log_alpha_mean: float = 10.0
  """First raw value of the mean's multipliers. Source: paper."""
  init_log_alpha_stddev: float = 1000.0
  """First raw value of the standard deviation's multipliers. Source: paper."""

  target_actor_period: int = 25
  """Updates between copies of the policy to its target [updates]. Source: paper."""
  target_critic_period: int = 100
  """Updates between copies of the critic to its target [updates]. Source: paper."""
  replay_steps: int = 1_000_000
  """Capacity of the replay [environment steps]. Source: reference."""
  min_replay_steps: int = 10_000
  """Steps in the replay before the first update [steps]. Source: chosen; some 200 trajectories, so
  that a first batch of 32 seldom repeats one."""
  scale_observations: bool = False
  """Whether inputs are normalised by their mean and deviation in the first data (`scaling.py`).
  Source: chosen; the paper names no scaling."""
  first_action: str = ZERO
  """What the policy's mean is about at the start: "zero", the middle of the actions' range, or
  "standing", the task's `standing_action`. Source: reference (zero)."""
  critic_warmup: int = 0
  """Updates at the start in which the critic alone learns; no environment steps pay for them
  [updates]. Source: chosen; the paper starts from scratch."""
  burn_in: int = 12
  """Steps of a trajectory of prior data that only unroll the LSTM, whose state there is unknown
  [steps]. Source: chosen, 8 to 16; R2D2 (Kapturowski et al. 2019) takes 20 and 40 of 80."""
  student_kl: float = 0.0
  """Weight of KL(policy || policy that the run began with), summed over action dimensions. Source:
  Haarnoja et al. 2023 and Tirumala et al. 2024 regularise to teachers so; the size is chosen."""
  student_kl_updates: int = 0
  """Updates after the critic's warm-up over which that weight falls to 0 along a line; 0: it does
  not [updates]."""
  student_kl_returns: tuple[float, float] | None = None
  """Mean returns of acting episodes between which the weight falls to 0; None: returns do not
  matter [reward]."""
  frozen_encoder: bool = False
  """Whether the image encoder stays what the run began with: the replay then holds its features in
  place of pictures."""
  frozen_memory: bool = False
  """Whether the LSTM stays, too: the replay then holds its outputs, and an update is one of MLPs on
  single transitions."""
  feature_copies: int = 2
  """Features of a frozen encoder for each picture: of the picture as it is, and of augmented ones.
  Source: chosen."""
  history: int = 1
  """Observations stacked by the agent [steps]. The suite's arrive with the paper's 5."""

  def __post_init__(self):
    if self.first_action not in FIRST_ACTIONS:
      raise ValueError(
        f"first_action must be one of {', '.join(FIRST_ACTIONS)}, found {self.first_action!r}."
      )
    if self.trajectory_length < 2:
      raise ValueError(f"trajectory_length must be 2 or more, found {self.trajectory_length}.")
    for name in _COUNTS:
      if getattr(self, name) < 1:
        raise ValueError(f"{name} must be 1 or more, found {getattr(self, name)}.")
    if not 0 <= self.discount <= 1:
      raise ValueError(f"discount must be 0 to 1, found {self.discount}.")
    for name in ("policy_layers", "critic_layers", "belief_layers"):
      if not getattr(self.network, name):
        raise ValueError(f"network.{name} must have a layer or more, found none.")
    if self.network.num_atoms < 2:
      raise ValueError(f"num_atoms must be 2 or more, found {self.network.num_atoms}.")
    if self.frozen_memory and not (self.frozen_encoder and self.network.recurrent):
      raise ValueError(
        "frozen_memory keeps the LSTM behind a frozen encoder: it needs frozen_encoder=true and "
        "network.recurrent=true."
      )
    if self.steps_per_update <= 0:
      raise ValueError(f"steps_per_update must be positive, found {self.steps_per_update}.")
    if self.network.vmin >= self.network.vmax:
      raise ValueError(
        f"vmin must lie below vmax, found {self.network.vmin} and {self.network.vmax}."
      )
    returns = self.student_kl_returns
    if returns is not None and not returns[0] < returns[1]:
      raise ValueError(f"student_kl_returns must rise, found {returns}.")
    if self.replay_steps < self.min_replay_steps:
      raise ValueError(
        f"replay_steps ({self.replay_steps}) must hold min_replay_steps ({self.min_replay_steps})."
      )


def override(config: DmpoConfig, assignments: Mapping[str, Any]) -> DmpoConfig:
  """Returns the settings with some changed; a dot reaches inside: {"network.vmax": 10.0}.

  Raises:
    ValueError: a setting is unknown, or a value is of another type or out of its range.
  """
  plain = to_plain(config)
  for path, value in assignments.items():
    *parents, name = path.split(".")
    node = plain
    for parent in parents:
      node = node.get(parent) if isinstance(node, dict) else None
    if not isinstance(node, dict) or name not in node:
      raise ValueError(f"Unknown setting {path!r} of {type(config).__name__}.")
    node[name] = to_plain(value)
  return from_plain(plain, type(config))
