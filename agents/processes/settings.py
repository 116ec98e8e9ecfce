"""Settings of a run of DMPO, besides those of the agent."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSettings:
  """Settings of a run."""

  environment: str
  """The environment's name; see `agents/environments/loading.py`."""
  run: Path
  """The run's folder."""
  seed: int = 0
  """Seed of parameters, sampling and, with an actor's number, of its episodes."""
  max_env_steps: int | None = None
  """Environment steps of the run; None: until it is stopped."""
  checkpoint_period: float = 300.0
  """Time between checkpoints [s]."""
  log_period: float = 10.0
  """Time between the learner's rows in the log [s]."""
  replay_on_disk: bool = False
  """Keep the replay in files of the run's folder, so that it survives the learner; otherwise it
  fills again after a restart."""
  minutes: float | None = None
  """Time of the run [min], over all its parts where it is resumed; None: until it is stopped."""
  init_from: Path | None = None
  """Folder of an exported policy to begin with, optimisers and critic being fresh; None: random."""
  prior_data: Path | None = None
  """Folder of a run whose replay (`replay/`) or episodes (a distillation's `data/`) are mixed into
  the batches; None: none."""
  prior_share: float = 0.5
  """Their share of every batch. Source: Tirumala et al. 2024 mix data of earlier runs evenly."""
  prior_steps: int = 200_000
  """Environment steps of them to read into memory: the last ones [steps]."""
  evaluation_period: int = 10_000
  """Environment steps between evaluations [steps]."""
  evaluation_episodes: int | None = None
  """Episodes of an evaluation; None: half of its protocol's trials, or 5 without a protocol."""
  evaluation_env: str | None = None
  """The environment of the evaluations; None: that of `loading.evaluation_name`."""

  def __post_init__(self):
    for name in ("evaluation_period", "evaluation_episodes"):
      value = getattr(self, name)
      if value is not None and value < 1:
        raise ValueError(
          f"--{name.replace('_', '-')} must be 1 or more, found {value}; without evaluations start "
          "no evaluator (--no-evaluator)."
        )
