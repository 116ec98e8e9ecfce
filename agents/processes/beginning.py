"""How a run begins, anew or from a checkpoint: first policy, replay, counters."""

import logging
from pathlib import Path
from typing import Any

import dm_env
import numpy as np

from nerf2real.agents.dmpo import config as configs
from nerf2real.agents.dmpo import training_state
from nerf2real.agents.dmpo.policy import acting, export
from nerf2real.agents.dmpo.replay.ring import Replay
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.dmpo.training_state import TrainingState
from nerf2real.agents.link.limiter import LimiterSettings, RateLimiter
from nerf2real.agents.processes.settings import RunSettings

_log = logging.getLogger(__name__)


def first_action(
  environment: dm_env.Environment, config: configs.DmpoConfig, name: str
) -> np.ndarray | None:
  """Returns the action that the policy's mean is about at the start [A]; None for zero.

  Raises:
    ValueError: The settings name the standing action, and the environment has none.
  """
  if config.first_action == configs.ZERO:
    return None
  action = getattr(acting.task_of(environment), "standing_action", None)
  if action is None:
    raise ValueError(
      f"{name} has no standing action, as first_action={configs.STANDING!r} needs: use another "
      'preset, or --set first_action="zero".'
    )
  return np.asarray(action, np.float32)


def with_exported_policy(folder: Path, state: TrainingState, layout: Layout) -> TrainingState:
  """Returns a fresh state with the policy of a folder.

  Raises:
    ValueError: The policy does not fit the environment or the networks.
  """
  export.check_beginning(folder, layout)
  return training_state.with_policy(state, export.load_arrays(folder))


def check_beginning(config: configs.DmpoConfig, init_from: str) -> None:
  """Raises ValueError where settings need a policy to begin with and there is none.

  Args:
    config: the agent's settings.
    init_from: the policy that the run began with; empty for random weights.
  """
  for name in ("student_kl", "frozen_encoder"):
    if getattr(config, name) and not init_from:
      raise ValueError(f"{name} needs a policy to begin with: add --init-from, or set it to 0.")


def open_replay(
  settings: RunSettings, config: configs.DmpoConfig, *, fields: Any, resume: bool
) -> Replay:
  """Opens the run's replay, in memory or in the run's folder.

  Args:
    settings: the run's.
    config: the agent's settings.
    fields: shapes and types, from `replay.trajectory_fields`.
    resume: takes a replay that lies in the folder.

  Raises:
    ValueError: The folder holds the replay of another run.
  """
  folder = settings.run / "replay"
  on_disk = settings.replay_on_disk or (resume and folder.exists())
  replay = Replay(
    fields,
    length=config.trajectory_length,
    capacity_steps=config.replay_steps,
    folder=folder if on_disk else None,
  )
  if replay.size and not resume:
    raise ValueError(f"{folder} holds the replay of another run: resume it, or remove it.")
  return replay


def make_limiter(
  settings: RunSettings,
  config: configs.DmpoConfig,
  *,
  replay: Replay,
  info: dict[str, Any],
  updates: int,
) -> RateLimiter:
  """Returns the run's counters: new ones, or those of a checkpoint.

  Args:
    settings: the run's.
    config: the agent's settings.
    replay: the run's.
    info: of the checkpoint that is continued; empty for a new run.
    updates: done so far.
  """
  steps = info.get("steps", 0)
  if info and replay.on_disk:
    steps += replay.steps_after(info["replay_inserted"])  # what came later is not lost
  limits = LimiterSettings(
    steps_per_update=config.steps_per_update,
    min_replay_steps=config.min_replay_steps,
    trajectory_steps=config.trajectory_length - 1,
    max_steps=settings.max_env_steps,
  )
  if not info:
    end = settings.max_env_steps
    if end is not None and end <= config.min_replay_steps:
      _log.warning(
        "No update will be made: %d steps fill the replay, the run has %d.",
        config.min_replay_steps,
        end,
      )
    return RateLimiter(limits)
  # Updates that were done cost what they did, also where further ones have another price.
  price = info.get("config", {}).get("steps_per_update", config.steps_per_update)
  limiter = RateLimiter(
    limits,
    steps=steps,
    updates=updates,
    refill_until=info.get("refill_until", 0),
    unpaid=info.get("unpaid_steps", 0) + updates * (price - config.steps_per_update),
  )
  if replay.steps < config.min_replay_steps:
    limiter.refill(held=replay.steps)
  return limiter
