"""Episodes that are the trials of an evaluation protocol, and exact intervals of their success."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import dm_env
from scipy import stats

_CONFIDENCE = 0.95


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

  def spread(self, count: int, *, shift: int = 0) -> list[Any]:
    """Returns `count` trials, evenly spread over the protocol; another shift gives others."""
    total = len(self._trials)
    count = min(count, total)
    return [self._trials[(index * total // count + shift) % total] for index in range(count)]

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


class Interval(NamedTuple):
  """An interval of a probability."""

  low: float
  high: float


def clopper_pearson(successes: int, trials: int, *, confidence: float = _CONFIDENCE) -> Interval:
  """Returns the exact binomial interval of a success rate (Clopper and Pearson 1934)."""
  if not 0 <= successes <= trials or not trials:
    raise ValueError(f"Expected 0 to {trials} successes of at least 1 trial, found {successes}.")
  tail = (1 - confidence) / 2
  low = stats.beta.ppf(tail, successes, trials - successes + 1) if successes else 0.0
  high = stats.beta.ppf(1 - tail, successes + 1, trials - successes) if successes < trials else 1.0
  return Interval(float(low), float(high))
