"""What a policy believes of a virtual robot's pictures at a trial's start, and of the simulation's.

  python benchmarks/learning/start_pictures.py --trials 10 44 48 --robot-seed 1

A policy of navigation drives on a virtual robot. At every step its picture is kept, and the
simulation's is rendered from the same head at the moment that the picture was taken. Both films are
then shown to the policy, and its belief is compared with the truth: after the first picture, over
all of them, and at the end.

Shape letters: N pictures, H, W picture.
"""

# ruff: noqa: E402  (threads are chosen before numpy is imported)

import dataclasses
from pathlib import Path
from typing import NamedTuple

from benchmarks import harness

harness.one_thread()

import cv2
import numpy as np

from nerf2real.agents.dmpo.policy.export import ExportedPolicy, load_policy
from nerf2real.core.files import atomic_path
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants import swaps
from nerf2real.evaluation.plants.rehearsed import RehearsedPlant
from nerf2real.evaluation.policies.learned import LearnedPolicy
from nerf2real.evaluation.policies.names import policy_folder
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.virtual.camera import LENS
from nerf2real.suite.op3 import constants
from nerf2real.suite.scene import open_scene
from nerf2real.suite.sensors.camera import CameraSettings

_SHOWN = 3  # a side of a shown pixel
_BETWEEN = 1.0  # s between the pictures that are shown


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to show."""

  policy: str = "shipped"
  """As of launch/evaluate.py."""
  trials: tuple[int, ...] = (10, 44, 48)
  """Of the navigation protocol."""
  seconds: float = 4.0
  """Of each [s]."""
  robot_seed: int = 1
  """Of the virtual robot."""
  pictures: Path | None = None
  """Folder for a picture of every trial: the robot's above the simulation's."""


class Film(NamedTuple):
  """Pictures of one trial."""

  robot: np.ndarray  # uint8 [N, H, W, 3], the virtual robot's
  simulated: np.ndarray  # uint8 [N, H, W, 3], the simulation's from the same head
  place: np.ndarray  # [N, 2] of the robot [m]
  yaw: np.ndarray  # [N] of its torso [rad]


class Errors(NamedTuple):
  """Of the belief, against the truth."""

  distance: np.ndarray  # [N] m, of its mean
  turn: np.ndarray  # [N] rad, of its likeliest component


def record(
  plant: RehearsedPlant, driver: LearnedPolicy, view: swaps.FieldView, trial: int, seconds: float
) -> Film:
  """Runs a trial until it is over, or some seconds long."""
  rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = []
  timestep = plant.start(plants.trials("navigation")[trial][1])
  sight = plant.sight()
  driver.reset(sight)
  assert plant.robot.camera is not None and sight.pose is not None
  while len(rows) * constants.CONTROL_TIMESTEP < seconds and not (
    timestep.last() or sight.collided or sight.fallen
  ):
    age = plant.robot.camera.read()[1]
    seen = view.picture(plant.robot.clock.now() - age)
    rows.append((timestep.observation["camera"], seen, sight.pose.xy, sight.pose.yaw))
    timestep = plant.step(driver.act(timestep.observation, goal=plant.goal, sight=sight))
    sight = plant.sight()
  return Film(*(np.asarray(column) for column in zip(*rows, strict=True)))


def errors(loaded: ExportedPolicy, pictures: np.ndarray, film: Film) -> Errors:
  """Shows pictures [N, H, W, 3] to a policy one after another and returns its belief's errors."""
  policy = loaded.policy
  nothing = np.zeros(loaded.layout.state_size, np.float32)  # the belief does not depend on it
  state = policy.initial_state()
  distances, turns = [], []
  for picture, place, yaw in zip(pictures, film.place, film.yaw, strict=True):
    step = policy.step(picture, nothing, state)
    state = step.state
    distances.append(np.linalg.norm(policy.believed_position(step.embedding) - place))
    logits, means, _ = policy.belief(step.embedding)
    turn = means[int(np.argmax(logits)), 2] - yaw
    turns.append(abs((turn + np.pi) % (2 * np.pi) - np.pi))
  return Errors(np.array(distances), np.array(turns))


def main(settings: Settings) -> None:
  """Records the trials and reports the errors."""
  scene = open_scene(None)
  folder = policy_folder(settings.policy, task=plants.TASKS["navigation"])
  driver = LearnedPolicy(folder, seed=0, stochastic=False)
  loaded = load_policy(folder)
  assert driver.image_size is not None
  plant = RehearsedPlant(
    scene,
    EvaluationSettings(plant="virtual", robot_seed=(settings.robot_seed,)),
    image_size=driver.image_size,
  )
  lens = CameraSettings().camera((LENS.height, LENS.width))
  view = swaps.field_view(scene, driver.image_size, lens)(plant.robot.body)
  rows: dict[str, dict[str, harness.Value]] = {}
  try:
    for trial in settings.trials:
      film = record(plant, driver, view, trial, settings.seconds)
      for whose, pictures in (("robot", film.robot), ("simulation", film.simulated)):
        found = errors(loaded, pictures, film)
        rows[f"trial {trial}, the {whose}'s pictures"] = {
          "seconds": len(pictures) * constants.CONTROL_TIMESTEP,
          "first_m": float(found.distance[0]),
          "first_rad": float(found.turn[0]),
          "mean_m": float(found.distance.mean()),
          "mean_rad": float(found.turn.mean()),
          "last_m": float(found.distance[-1]),
        }
      if settings.pictures is not None:
        show(film, settings.pictures / f"trial_{trial}_robot_{settings.robot_seed}.png")
  finally:
    plant.close()
  harness.finish("start_pictures", rows, settings, seed=settings.robot_seed)


def show(film: Film, path: Path) -> None:
  """Writes pictures of every second, the robot's above the simulation's."""
  chosen = range(0, len(film.robot), round(_BETWEEN / constants.CONTROL_TIMESTEP))
  lines = [np.concatenate([film[row][i] for i in chosen], axis=1) for row in (0, 1)]
  picture = np.concatenate(lines).repeat(_SHOWN, 0).repeat(_SHOWN, 1)
  path.parent.mkdir(parents=True, exist_ok=True)
  with atomic_path(path) as partial:
    cv2.imwrite(str(partial), picture[..., ::-1])


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
