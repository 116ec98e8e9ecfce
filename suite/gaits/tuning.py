"""Searches for the gait's parameters in simulation, by CMA-ES over walks on an empty floor.

Every candidate walks in several worlds (servo strength, friction, delays, floor), so that the gait
does not depend on one of them. The best parameters are the defaults in
`suite.gaits.walk.GaitSettings`.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from nerf2real import suite
from nerf2real.suite.effects import Effect
from nerf2real.suite.environment import Environment
from nerf2real.suite.gaits import walk
from nerf2real.suite.gaits.evolution import Evolution
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import RandomisationSettings

# Parameter: (lower, upper) bound of the search.
BOUNDS = {
  "period": (0.3, 1.0),
  "height": (0.16, 0.214),
  "spread": (0.022, 0.07),
  "sway": (-0.03, 0.05),
  "sway_lead": (-1.5, 1.5),
  "lift": (0.005, 0.06),
  "swing": (0.25, 0.55),
  "stride": (0.02, 0.12),
  "backset": (-0.03, 0.04),
  "lean": (-0.15, 0.25),
  "tilt": (-0.1, 0.2),
  "lead": (0.0, 0.15),
  "pitch_rate_gain": (-0.1, 0.1),
  "roll_rate_gain": (-0.1, 0.1),
  "pitch_gain": (-0.5, 0.5),
  "roll_gain": (-0.5, 0.5),
}
# Worlds in which a candidate walks; the first is the nominal one.
WORLDS: tuple[tuple[Effect, ...], ...] = (
  (),
  (
    Effect("motor_gain", None, {"gain": 0.87}),
    Effect("load_friction", None, {"coefficient": 0.15}),
  ),
  (
    Effect("motor_gain", None, {"gain": 1.2}),
    Effect("floor_friction", None, {"scale": 0.6}),
    Effect("command_delay", None, {"delay": 0.015}),
  ),
  (
    Effect("coulomb_friction", None, {"torque": 0.1}),
    Effect("floor_slope", None, {"y": 0.01}),
    Effect("parameter_error", None, {"damping": 0.85}),
  ),
)
_MIN_POPULATION = 2  # the better half of it moves the search
_TARGET_SPEED = 0.15  # m/s: walking faster than this earns nothing more
_TARGET_TURN = 0.3  # rad/s at full turn


def make_environments(count: int, seconds: float) -> list[Environment]:
  """Returns one environment without pictures for each world."""
  settings = RandomisationSettings(pushes=False)
  environments = [
    suite.load(
      "nerf_nav",
      scene=EmptyFloor(),
      effects=effects,
      image_size=None,
      random=index,
      time_limit=seconds,
      randomisation=settings,
      privileged=False,
    )
    for index, effects in enumerate(WORLDS[:count])
  ]
  for environment in environments:
    environment.task.set_start(Pose(0.0, 0.0, 0.0))
  return environments


def walk_score(environment, gait: walk.Gait, command: walk.Command) -> tuple[float, dict]:
  """Walks an episode; returns its score (about 1 is good) and what happened."""
  timestep = environment.reset()
  gait.reset()
  task = environment.task
  effort, yaws = 0.0, [0.0]
  while not timestep.last():
    observation = timestep.observation
    action = gait.act(
      command, gyroscope=observation["gyroscope"][-1], gravity=observation["gravity"][-1]
    )
    timestep = environment.step(action)
    yaws.append(task.state.yaw)
    effort += float(np.abs(task.state.angular_velocity[:2]).sum()) * constants.CONTROL_TIMESTEP
  outcome, limit = task.outcome, task.settings.time_limit
  x, y = task.state.position[:2]
  yaw = float(np.unwrap(yaws)[-1])
  alive = min(1.0, outcome.duration / limit)
  moving = limit - 1.0  # s: the rest is crouching and starting
  wanted = command.forward * _TARGET_SPEED * moving
  if command.turn:
    turned = yaw / (np.sign(command.turn) * _TARGET_TURN * moving)
    gain = min(turned, 1.0)
  else:
    gain = min(x / wanted, 1.0) - 0.5 * abs(y) / wanted - 0.4 * abs(yaw)
  shaking = 0.1 * effort / max(outcome.duration, 0.1)
  score = gain - shaking if outcome.ending is None else alive - 1.5 + 0.4 * min(gain, 1.0)
  return score, {
    "x": float(x),
    "y": float(y),
    "yaw": yaw,
    "seconds": outcome.duration,
    "ending": outcome.ending,
    "shaking": shaking,
  }


def settings_of(vector: np.ndarray) -> walk.GaitSettings:
  """Returns settings from a point of the unit cube [P]."""
  low, high = np.array(list(BOUNDS.values())).T
  values = low + (high - low) * np.clip(vector, 0, 1)
  return walk.GaitSettings(**dict(zip(BOUNDS, (float(v) for v in values), strict=True)))


def vector_of(settings: walk.GaitSettings) -> np.ndarray:
  """Inverts `settings_of`."""
  low, high = np.array(list(BOUNDS.values())).T
  return (np.array([getattr(settings, name) for name in BOUNDS]) - low) / (high - low)


def evaluate(vector: np.ndarray, environments, *, turning: bool) -> tuple[float, list[dict]]:
  """Returns a candidate's score over all worlds, and what happened in each walk."""
  outside = np.abs(vector - np.clip(vector, 0, 1)).sum()
  gait = walk.Gait(settings_of(vector))
  commands = [walk.Command(1.0, 0.0)]
  if turning:
    commands += [walk.Command(0.3, 1.0), walk.Command(0.3, -1.0)]
  scores, notes = [], []
  for environment in environments:
    for command in commands:
      score, note = walk_score(environment, gait, command)
      scores.append(score)
      notes.append(note)
    if max(scores) < -0.9:  # falls at once in the nominal world: not worth the others
      break
  return float(0.5 * np.mean(scores) + 0.5 * np.min(scores) - outside), notes


class Round(NamedTuple):
  """What is known after a generation of the search."""

  generation: int
  best: walk.GaitSettings  # of all rounds
  best_score: float
  walks: list[dict[str, Any]]  # of the best
  mean: walk.GaitSettings  # where the search stands
  scores: np.ndarray  # [population] of this round


def search(
  *,
  generations: int,
  population: int,
  seconds: float,
  worlds: int,
  turning: bool,
  start: walk.GaitSettings,
  spread: float,
  seed: int,
) -> Iterator[Round]:
  """Searches for the gait that walks best over all worlds; yields after every generation.

  Args:
    generations: Rounds of the search.
    population: Candidates in a round.
    seconds: Length of a walk [s].
    worlds: How many of WORLDS are walked in.
    turning: Whether turning walks count too.
    start: The first candidate, and the centre of the first round.
    spread: Width of the first round, as a share of the bounds.
    seed: Of the search.

  Raises:
    ValueError: Too few candidates, or none or more worlds than there are.
  """
  if population < _MIN_POPULATION or not 1 <= worlds <= len(WORLDS):
    raise ValueError(
      f"Found a population of {population} in {worlds} worlds, expected {_MIN_POPULATION} or more "
      f"in 1 to {len(WORLDS)}."
    )
  environments = make_environments(worlds, seconds)
  evolution = Evolution(vector_of(start), spread, population, seed)
  best, best_vector, walks = -np.inf, evolution.mean, list[dict[str, Any]]()
  for generation in range(generations):
    candidates = evolution.ask()
    if generation == 0:
      candidates[0] = evolution.mean
    results = [evaluate(c, environments, turning=turning) for c in candidates]
    scores = np.array([score for score, _ in results])
    evolution.tell(candidates, scores)
    leader = int(scores.argmax())
    if scores[leader] > best:
      best, best_vector = float(scores[leader]), candidates[leader]
      walks = results[leader][1]
    yield Round(
      generation, settings_of(best_vector), best, walks, settings_of(evolution.mean), scores
    )
