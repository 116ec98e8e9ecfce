"""The learner's data: its replay, prior data beside it, and features of a frozen encoder."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.networks import Params
from nerf2real.agents.dmpo.replay.features import FrozenEncoder, stored_fields
from nerf2real.agents.dmpo.replay.prior import PriorData, sample_mixed, write_layout
from nerf2real.agents.dmpo.replay.ring import check_trajectory, trajectory_fields
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.processes import beginning
from nerf2real.agents.processes.settings import RunSettings

_log = logging.getLogger(__name__)


class Experience:
  """Takes trajectories in and gives batches."""

  def __init__(
    self,
    settings: RunSettings,
    config: DmpoConfig,
    *,
    layout: Layout,
    policy: Params,
    resume: bool,
  ):
    """Opens the replay and reads the prior data.

    Args:
      settings: of the run.
      config: the agent's settings.
      layout: the environment's.
      policy: parameters of the policy, for its LSTM's size and its encoder.
      resume: takes the replay that lies in the run's folder.

    Raises:
      ValueError: the replay or the prior data are of another run or environment, or settings do
        not fit together.
    """
    _check(settings, config, layout)
    self._config, self._share = config, settings.prior_share
    lstm_size = policy["lstm"]["b"].shape[0] // 4 if "lstm" in policy else 0
    self._lstm_size = 0 if config.frozen_memory else lstm_size  # in the batches
    self._fields = trajectory_fields(layout, lstm_size=lstm_size)
    self._encoder: FrozenEncoder | None = None
    if config.frozen_encoder:
      self._encoder = FrozenEncoder(
        policy, config, length=config.trajectory_length, seed=settings.seed
      )
    fields = stored_fields(self._fields, config)
    self.replay = beginning.open_replay(settings, config, fields=fields, resume=resume)
    if self.replay.on_disk:
      write_layout(settings.run / "replay", layout)
    self._prior: PriorData | None = None
    if settings.prior_data is not None:
      self._prior = PriorData(settings.prior_data, layout, max_steps=settings.prior_steps)
      _log.info("%s: %d steps of prior data.", settings.prior_data, self._prior.steps)
      if self._encoder is not None:
        self._prior.encode(self._encoder, burn_in=config.burn_in)

  def insert(self, trajectory: Mapping[str, np.ndarray], actor: int, number: int) -> int:
    """Checks and keeps a trajectory; returns its transitions.

    Raises:
      ValueError: it does not fit.
      OSError: the disk is full.
    """
    steps = check_trajectory(trajectory, self._fields, length=self._config.trajectory_length)
    if self._encoder is not None:
      trajectory = self._encoder.replace(trajectory)
    self.replay.insert(trajectory, actor=actor, number=number)
    return steps - 1

  def sample(self, rng: np.random.Generator) -> dict[str, Any]:
    """Draws a batch, with the configured share of prior data."""
    if self._prior is None:
      return self.replay.sample(rng, self._config.batch_size)
    return sample_mixed(
      self.replay,
      self._prior,
      rng,
      batch_size=self._config.batch_size,
      share=self._share,
      burn_in=self._config.burn_in,
      lstm_size=self._lstm_size,
    )


def _check(settings: RunSettings, config: DmpoConfig, layout: Layout) -> None:
  if not 0 <= settings.prior_share <= 1:
    raise ValueError(f"--prior-share must be 0 to 1, found {settings.prior_share}.")
  if config.frozen_encoder and layout.image_shape is None:
    raise ValueError(
      f"frozen_encoder freezes the encoder of pictures, {settings.environment} gives none: "
      "--set frozen_encoder=false."
    )
