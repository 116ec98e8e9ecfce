"""Settings of the agent by name, with why they differ from the paper's."""

from collections.abc import Callable, Mapping

from nerf2real.agents.dmpo.config import STANDING, AugmentationConfig, DmpoConfig, NetworkConfig


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
