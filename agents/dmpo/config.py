"""Settings of the agent. The defaults are the paper's table of DMPO hyperparameters.

Sources named below. Paper: Byravan et al. 2022, NeRF2Real, appendix, table "List of DMPO
hyperparameters" (or the place named). Reference: the public DMPO of Acme (Hoffman et al. 2020).
IMPALA: Espeholt et al. 2018, figure 3. Chosen: left open by the paper; the reason is given.
A unit is given where there is one; everything else is a pure number.
"""

import dataclasses
from collections.abc import Callable, Mapping
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


def paper() -> DmpoConfig:
  """The paper's settings."""
  return DmpoConfig()


def state() -> DmpoConfig:
  """Settings for small tasks from state on a CPU: rewards in [0, 1], episodes of 1000 short steps.

  Begins with those of the reference for the control suite (64 transitions sampled for one inserted,
  batches of 256: an update every 4 steps), and differs where learning cartpole's swing-up was slow
  (tried on seed 0 with actor and learner in one process, several changes at a time):
  - 32 trajectories of 9 observations instead of 16 of 17: less alike transitions in a batch.
  - Networks half as wide: 2.4 times the updates a second, no worse.
  - Values in [-100, 100]: such rewards sum to 100 at most with a discount of 0.99, and a symmetric
    support makes the first critic's value 0. One that began at 50 took 10,000 steps to unlearn it.
  - A hundred times the bound on the out-of-bounds objective: with the paper's, the mean drifts
    beyond 2, where every sample is clipped alike and the critic no longer separates them.
  - First temperatures and multipliers near 1: from 10, the first 1,000 updates weigh all samples
    alike.
  - Learning rates of 1e-3: all else equal, 3e-4 reached 252 at 30,000 steps, 1e-3 498 at 15,000.
  - A target critic of 50 updates instead of 100.
  """
  return DmpoConfig(
    network=NetworkConfig(
      policy_layers=(128, 128), critic_layers=(128, 128, 128), vmin=-100.0, vmax=100.0
    ),
    policy_learning_rate=1e-3,
    critic_learning_rate=1e-3,
    epsilon_mean=0.01,
    epsilon_action_penalty=0.1,
    init_log_temperature=0.0,
    init_log_alpha_mean=1.0,
    trajectory_length=9,
    batch_size=32,
    steps_per_update=4.0,
    n_step=4,
    target_critic_period=50,
    min_replay_steps=1000,
  )


def vision_small() -> DmpoConfig:
  """Settings for small tasks from pictures on a CPU: the paper's structure, narrower.

  Small pictures' convolutions take most of an update on a CPU: few channels, 8 trajectories.
  First temperatures, the bound on the out-of-bounds objective and learning rates as in `state`.
  """
  return DmpoConfig(
    network=NetworkConfig(
      policy_layers=(64, 64),
      critic_layers=(64, 64),
      image_channels=(4, 8, 8),
      image_blocks=1,
      image_features=32,
      lstm_size=32,
      vmin=-25.0,
      vmax=25.0,
    ),
    augmentation=AugmentationConfig(enabled=False),
    policy_learning_rate=1e-3,
    critic_learning_rate=1e-3,
    epsilon_mean=0.01,
    epsilon_action_penalty=0.1,
    init_log_temperature=0.0,
    init_log_alpha_mean=1.0,
    trajectory_length=16,
    batch_size=8,
    steps_per_update=8.0,
    target_critic_period=50,
    min_replay_steps=500,
    replay_steps=100_000,
  )


def op3_small() -> DmpoConfig:
  """Settings for `suite:nerf_nav` and `suite:ball_push` on a machine with few cores.

  With the paper's settings a policy from scratch falls within 13 steps, its noise of 0.7 fells any
  gait, and an update takes seconds on a core.
  - The first policy stands: its mean is the standing action, and noise of 0.1 leaves the robot on
    its feet for 10 s (0.3: for 1.4 s).
  - Noise may shrink: the KL of a relative change d of a deviation is about d^2, so that a bound of
    1e-5 lets it halve in 5,500 updates, the paper's 1e-6 in 17,000. Multipliers begin at 10.
  - Observations are scaled: unscaled, the accelerometer holds 88 % of the squared input, and the
    joints' positions 4 %.
  - Multipliers, temperatures, the penalty's bound and the range of values as in `state`.
  - Networks and batches of about a tenth of the paper's time.
  - The critic learns alone first. The E-step weighs the samples with a KL of `epsilon` whatever
    makes their values differ, so that noise of 0.1 under a critic that does not know actions yet is
    a random walk of a policy that stood (on `dm_control:cartpole:balance` returns fell). A critic's
    values reach n_step * updates / target_critic_period steps ahead: after 1,000 updates, with
    copies every 50, the 100 steps that a discount of 0.99 looks ahead.
  """
  return DmpoConfig(
    network=NetworkConfig(
      critic_layers=(256, 256, 256),
      image_channels=(8, 16, 16),
      image_blocks=1,
      image_features=128,
      lstm_size=128,
      init_stddev=0.1,
      vmin=-100.0,
      vmax=100.0,
    ),
    policy_learning_rate=3e-4,
    critic_learning_rate=3e-4,
    epsilon_mean=0.01,
    epsilon_stddev=1e-5,
    epsilon_action_penalty=0.1,
    init_log_temperature=0.0,
    init_log_alpha_mean=1.0,
    init_log_alpha_stddev=10.0,
    trajectory_length=24,
    batch_size=16,
    min_replay_steps=5_000,
    replay_steps=200_000,
    target_critic_period=50,
    scale_observations=True,
    first_action=STANDING,
    critic_warmup=1_000,
  )


def nerf_nav_finetune() -> DmpoConfig:
  """Settings for `suite:nerf_nav` from a student of `launch/distill.py` (--init-from).

  - Networks of the student; its noise begins at 0.1, which leaves a walking robot on its feet, and
    may shrink as in `op3_small`.
  - The critic, which begins at random, learns alone first: a policy that follows it is undone. Its
    values reach n_step * updates / target_critic_period = 300 steps ahead by then.
  - The policy stays near the student: where the E-step moves the mean by d deviations along the
    values' gradient, a weight c of the KL holds it at d / c, here at about one. With c falling from
    0.1 and three times the rate the policy was 17 nats away after 4,000 updates and 12,000 steps,
    the critic's values had risen to twice those of its data, and 1 of 46 episodes reached the goal.
  - Encoder and LSTM are frozen. An update then takes 37 ms of a core where 16 trajectories of 32
    observations with 20 sampled actions, the encoder alone frozen, take 163 ms.
  - Windows of 12 observations: without unrolls there is no need for longer ones, and 24 of them are
    less alike than 9 of 32.
  - Values from those of a fall to those of a robot that stays at the goal (1.3 a step).
  - The paper's rate for the policy; multipliers, temperatures and the penalty's bound as in
    `op3_small`.
  """
  return DmpoConfig(
    network=NetworkConfig(critic_layers=(256, 256, 256), init_stddev=0.1, vmin=-30.0, vmax=130.0),
    critic_learning_rate=3e-4,
    epsilon_stddev=1e-5,
    epsilon_action_penalty=0.1,
    init_log_temperature=0.0,
    init_log_alpha_stddev=10.0,
    trajectory_length=12,
    batch_size=24,
    num_samples=10,
    steps_per_update=3.0,
    target_critic_period=50,
    min_replay_steps=8_000,
    replay_steps=200_000,
    scale_observations=True,
    critic_warmup=3_000,
    student_kl=0.5,
    student_kl_updates=40_000,
    frozen_encoder=True,
    frozen_memory=True,
    feature_copies=1,
  )


PRESETS: Mapping[str, Callable[[], DmpoConfig]] = {
  "paper": paper,
  "state": state,
  "vision_small": vision_small,
  "op3_small": op3_small,
  "nerf_nav_finetune": nerf_nav_finetune,
}


def preset(name: str) -> DmpoConfig:
  """Returns the settings called name; raises ValueError for an unknown one."""
  if name not in PRESETS:
    raise ValueError(f"Unknown preset {name!r}: expected one of {', '.join(PRESETS)}.")
  return PRESETS[name]()


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
