"""Which part of a robot's pictures costs a policy its place: the room's, or the ball's.

  python benchmarks/learning/picture_parts.py --policies agents/policies/ball_push --trials 0 18 33

A policy pushes the ball on a virtual robot. At every state its picture is kept and the simulation's
is rendered, with the ball and without, so that either one's ball can be put into the other one's
room. Every policy is then shown the four films, and its belief compared with the truth.

Shape letters: N pictures, H, W picture.
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import harness

harness.one_thread()

import numpy as np

from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.dmpo.policy.export import ExportedPolicy, load_policy
from nerf2real.agents.environments.loading import make_environment
from nerf2real.core import files
from nerf2real.evaluation.plants.rehearsed import RehearsedPlant
from nerf2real.evaluation.policies.learned import LearnedPolicy
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.suite import protocols
from nerf2real.suite.op3 import constants

_TILT = constants.JOINT_NAMES.index("head_tilt")
_LOW = -0.45  # rad of the head's tilt below which a picture is mostly floor; chosen
_LATE = 2  # control steps that a picture is late, for which both pictures differ least (of 0 to 3)
_ABOVE = 50.0  # m, where a ball is not seen
_LEAST = 6  # 8-bit levels by which a picture with a ball differs from one without


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to show to whom."""

  policies: tuple[str, ...]
  """Folders of exported policies of ball pushing; the first one drives."""
  trials: tuple[int, ...] = (0, 18, 33)
  """Of the ball's protocol."""
  seconds: float = 20.0
  """Of each [s]."""
  robot_seed: int = 1
  """Of the virtual robot."""
  film: Path | None = None
  """File of the films: read if it is there, or else written."""


class Film(NamedTuple):
  """Pictures of one run over all trials."""

  robot: np.ndarray  # uint8 [N, H, W, 3], the virtual robot's
  simulated: np.ndarray  # uint8 [N, H, W, 3], the simulation's at the same states
  bare: np.ndarray  # uint8 [N, H, W, 3], without the ball
  place: np.ndarray  # [N, 2] of the robot [m]
  tilt: np.ndarray  # [N] of its head [rad]
  trial: np.ndarray  # [N]


def record(settings: Settings) -> Film:
  """Runs the first policy on the virtual robot."""
  driver = LearnedPolicy(Path(settings.policies[0]), seed=0, stochastic=False)
  environment = make_environment("suite:ball_push?pushes=false", seed=0)
  environment.reset()
  task = task_of(environment)
  plant = RehearsedPlant(
    task.scene,
    EvaluationSettings(protocol="ball", plant="virtual", robot_seed=(settings.robot_seed,)),
    image_size=driver.image_size,
  )
  rows: list[tuple[Any, ...]] = []
  try:
    for trial in settings.trials:
      rows += _episode(task, plant, driver, trial, settings.seconds)
  finally:
    plant.close()
    environment.close()
  return Film(*(np.asarray(column) for column in zip(*rows, strict=True)))


def _episode(
  task: Any, plant: RehearsedPlant, driver: LearnedPolicy, trial: int, seconds: float
) -> list[tuple[Any, ...]]:
  rows: list[tuple[Any, ...]] = []
  states: list[Any] = []
  timestep = plant.start(protocols.ball()[trial])
  driver.reset(plant.sight())
  while not timestep.last() and len(rows) * constants.CONTROL_TIMESTEP < seconds:
    truth = plant.robot.truth()
    states.append(truth)
    seen = states[max(0, len(states) - 1 - _LATE)]
    pictures = [_rendered(task, seen, ball) for ball in (seen.ball, (*seen.ball[:2], _ABOVE))]
    observation = timestep.observation
    place, tilt = truth.position[:2].copy(), truth.joints[_TILT]
    rows.append((observation["camera"], *pictures, place, tilt, trial))
    timestep = plant.step(driver.act(observation, goal=plant.goal, sight=plant.sight()))
  return rows


def _rendered(task: Any, truth: Any, ball: Any) -> np.ndarray:
  task.put_ball(ball[:2], height=ball[2])
  return task.picture_of(position=truth.position, rotation=truth.rotation, joints=truth.joints)


def films(film: Film) -> dict[str, np.ndarray]:
  """Returns what is shown, by name: uint8 [N, H, W, 3]."""
  ball = np.abs(film.simulated.astype(int) - film.bare).max(axis=-1) > _LEAST
  rows = [np.roll(ball, shift, axis=1) for shift in (-1, 0, 1)]
  wide = np.any([np.roll(row, shift, axis=2) for row in rows for shift in (-1, 0, 1)], axis=0)
  return {
    "robot's picture": film.robot,
    "simulation's picture": film.simulated,
    "robot's room, simulation's ball": np.where(wide[..., None], film.simulated, film.robot),
    "simulation's room, robot's ball": np.where(wide[..., None], film.robot, film.simulated),
    "simulation's room, no ball": film.bare,
  }


def errors(loaded: ExportedPolicy, pictures: np.ndarray, film: Film) -> np.ndarray:
  """Distances [N] [m] of the belief from the truth, its state fresh in every trial."""
  found, policy = np.empty(len(pictures)), loaded.policy
  nothing = np.zeros(loaded.layout.state_size, np.float32)  # the belief does not depend on it
  for index, picture in enumerate(pictures):
    if index == 0 or film.trial[index] != film.trial[index - 1]:
      state = policy.initial_state()
    step = policy.step(picture, nothing, state)
    state = step.state
    found[index] = np.linalg.norm(policy.believed_position(step.embedding) - film.place[index])
  return found


def main(settings: Settings) -> None:
  """Shows the films to every policy."""
  path = settings.film
  if path is not None and path.exists():
    with np.load(path, allow_pickle=False) as stored:
      film = Film(**{name: stored[name] for name in Film._fields})
  else:
    film = record(settings)
  if path is not None and not path.exists():
    with files.atomic_path(path) as partial:
      np.savez_compressed(partial, **film._asdict())
  low = film.tilt < _LOW
  rows: dict[str, dict[str, harness.Value]] = {}
  for folder in settings.policies:
    loaded = load_policy(folder)
    for name, pictures in films(film).items():
      found = errors(loaded, pictures, film)
      rows[f"{folder}: {name}"] = {
        "mean_m": float(found.mean()),
        "head_low_m": float(found[low].mean()),
        "head_high_m": float(found[~low].mean()),
      }
  harness.finish("picture_parts", rows, settings, seed=settings.robot_seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
