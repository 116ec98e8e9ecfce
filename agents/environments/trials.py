"""Episodes that are the trials of an evaluation protocol."""

from collections.abc import Sequence
from typing import Any

import dm_env


class Trials(dm_env.Environment):
  """Gives one trial of a protocol after another; an episode ends when its goal is reached.

  Trials are set up as `launch/evaluate.py` does in simulation: what an episode draws depends on the
  seed and the trial alone. After the last trial the first one comes again, with other draws.
  """

  def __init__(self, environment: Any, trials: Sequence[Any], *, seed: int):
    """Wraps an environment.

    Args:
      environment: from `suite.load`.
      trials: what its task's `set_trial` takes.
      seed: of what the episodes draw.
    """
    self._environment = environment
    self._trials = tuple(trials)
    self._seed = seed
    self._given = 0

  @property
  def count(self) -> int:
    """Trials of the protocol."""
    return len(self._trials)

  def choose(self, trials: Sequence[Any], *, seed: int) -> None:
    """Begins again with some trials of the protocol.

    Args:
      trials: from `spread`.
      seed: of what the episodes draw.
    """
    self._trials, self._seed, self._given = tuple(trials), seed, 0

  def spread(self, count: int, *, without: Sequence[Any] = ()) -> list[Any]:
    """Returns `count` trials, or all there are, evenly spread over the protocol.

    Args:
      count: how many.
      without: trials that are left out, unless these are all.
    """
    left = [trial for trial in self._trials if trial not in without] or list(self._trials)
    total = len(left)
    count = min(count, total)
    return [left[index * total // count] for index in range(count)]

  def reset(self) -> dm_env.TimeStep:
    again, index = divmod(self._given, len(self._trials))
    self._given += 1
    trial = self._trials[index]
    self._environment.random_state.seed([self._seed + again, trial.seed])
    self._environment.task.set_trial(trial)
    return self._environment.reset()

  def step(self, action: Any) -> dm_env.TimeStep:
    timestep = self._environment.step(action)
    if self._environment.task.success and not timestep.last():
      return timestep._replace(step_type=dm_env.StepType.LAST)
    return timestep

  def observation_spec(self) -> Any:
    return self._environment.observation_spec()

  def action_spec(self) -> Any:
    return self._environment.action_spec()

  def close(self) -> None:
    self._environment.close()
