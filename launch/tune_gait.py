"""Searches for the gait's parameters in simulation: walks on an empty floor, better ones win.

Every candidate walks in several worlds (servo strength, friction, delays, floor), so that the gait
does not lean on one of them. Prints the best parameters as JSON; they are the defaults in
`suite.gaits.walk.GaitSettings`.

python launch/tune_gait.py --generations 40 --out out/gait.json
"""

import dataclasses
import json
import time
from pathlib import Path

import numpy as np
import tyro

from nerf2real import suite
from nerf2real.suite.effects import Effect
from nerf2real.suite.gaits import walk
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.op3 import constants
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.tasks.base import Start

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
_TARGET_SPEED = 0.15  # m/s: walking faster than this earns nothing more
_TARGET_TURN = 0.3  # rad/s at full turn


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Searches for the gait's parameters in simulation."""

  generations: int = 40
  """Rounds of the search."""
  population: int = 20
  """Candidates in a round."""
  seconds: float = 7.0
  """Length of a walk."""
  worlds: int = len(WORLDS)
  """How many of the worlds are walked in."""
  turning: bool = False
  """Whether turning walks count too."""
  start: Path | None = None
  """JSON of an earlier search to go on from."""
  spread: float = 0.3
  """Width of the first round, as a share of the bounds."""
  seed: int = 0
  """Seed of the search."""
  out: Path | None = None
  """Where the best parameters are written after every round."""


def make_environments(count: int, seconds: float) -> list[suite.environment.Environment]:
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
    environment.task.set_start(Start((0.0, 0.0), 0.0))
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


class Evolution:
  """CMA-ES without step-size control by path: recombination, rank-mu and rank-one update.

  Source: Hansen, The CMA evolution strategy: a tutorial (arXiv 1604.00772), defaults of table 1.
  """

  def __init__(self, mean: np.ndarray, sigma: float, population: int, seed: int):
    self._rng = np.random.default_rng(seed)
    self.mean, self._sigma, size = mean.copy(), sigma, len(mean)
    parents = population // 2
    weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    self._weights = weights / weights.sum()
    effective = 1 / (self._weights**2).sum()
    self._population = population
    self._c_sigma = (effective + 2) / (size + effective + 5)
    self._damping = 1 + self._c_sigma + 2 * max(0, np.sqrt((effective - 1) / (size + 1)) - 1)
    self._c_path = (4 + effective / size) / (size + 4 + 2 * effective / size)
    self._c_one = 2 / ((size + 1.3) ** 2 + effective)
    rank_mu = 2 * (effective - 2 + 1 / effective) / ((size + 2) ** 2 + effective)
    self._c_mu = min(1 - self._c_one, rank_mu)
    self._effective, self._expected = effective, np.sqrt(size) * (1 - 1 / (4 * size))
    self._covariance = np.eye(size)
    self._path_sigma, self._path = np.zeros(size), np.zeros(size)

  def ask(self) -> np.ndarray:
    """Returns candidates [population, P]."""
    values, vectors = np.linalg.eigh(self._covariance)
    self._root = vectors * np.sqrt(np.maximum(values, 1e-12))
    self._inverse = vectors / np.sqrt(np.maximum(values, 1e-12)) @ vectors.T
    noise = self._rng.standard_normal((self._population, len(self.mean)))
    return self.mean + self._sigma * noise @ self._root.T

  def tell(self, candidates: np.ndarray, scores: np.ndarray) -> None:
    """Moves towards the candidates with the highest scores [population]."""
    best = candidates[np.argsort(-scores)[: len(self._weights)]]
    steps = (best - self.mean) / self._sigma
    step = self._weights @ steps
    self.mean = self.mean + self._sigma * step
    c, mu = self._c_sigma, self._effective
    self._path_sigma = (1 - c) * self._path_sigma + np.sqrt(c * (2 - c) * mu) * self._inverse @ step
    c = self._c_path
    self._path = (1 - c) * self._path + np.sqrt(c * (2 - c) * mu) * step
    self._covariance = (
      (1 - self._c_one - self._c_mu) * self._covariance
      + self._c_one * np.outer(self._path, self._path)
      + self._c_mu * (steps.T * self._weights) @ steps
    )
    length = np.linalg.norm(self._path_sigma) / self._expected
    self._sigma *= float(np.exp(self._c_sigma / self._damping * (length - 1)))


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


def main() -> None:
  """Parses the command line and searches."""
  arguments = tyro.cli(Arguments, description=__doc__)
  environments = make_environments(arguments.worlds, arguments.seconds)
  settings = walk.GaitSettings()
  if arguments.start is not None:
    known = json.loads(arguments.start.read_text())["settings"]
    settings = dataclasses.replace(settings, **{k: known[k] for k in BOUNDS if k in known})
  search = Evolution(vector_of(settings), arguments.spread, arguments.population, arguments.seed)
  best, best_vector = -np.inf, search.mean
  begin = time.monotonic()
  for generation in range(arguments.generations):
    candidates = search.ask()
    if generation == 0:
      candidates[0] = search.mean
    results = [evaluate(c, environments, turning=arguments.turning) for c in candidates]
    scores = np.array([score for score, _ in results])
    search.tell(candidates, scores)
    if scores.max() > best:
      best, best_vector = float(scores.max()), candidates[int(scores.argmax())]
      notes = results[int(scores.argmax())][1]
    text = f"{generation:3d} {time.monotonic() - begin:6.0f} s  best {best:+.3f}  round "
    text += f"{scores.max():+.3f} median {np.median(scores):+.3f}  {notes[0]}"
    print(text, flush=True)
    if arguments.out is not None:
      record = {
        "score": best,
        "settings": dataclasses.asdict(settings_of(best_vector)),
        "walks": notes,
        "mean": dataclasses.asdict(settings_of(search.mean)),
      }
      arguments.out.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
  main()
