"""The protocol of plants in an evaluation: set a trial up, step it, observe the robot."""

import abc
from pathlib import Path
from typing import Any, NamedTuple

import dm_env
import numpy as np

from nerf2real.core import errors, files
from nerf2real.evaluation.plants import perturbations
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.suite import protocols
from nerf2real.suite.pose import Pose
from nerf2real.suite.protocols import BALL, PROTOCOLS, BallTrial, NavigationTrial
from nerf2real.suite.tasks import catalogue, rewards

Trial = NavigationTrial | BallTrial

TASKS = {name: task for task, names in catalogue.PROTOCOLS.items() for name in names}
"""Task of every protocol."""


class Sight(NamedTuple):
  """An observer's measurements in an episode; None without an observer."""

  pose: Pose | None
  ball: np.ndarray | None  # [2] m
  collided: bool
  fallen: bool


class Plant(abc.ABC):
  """Where episodes are run."""

  name: str  # "sim", "virtual" or "robot"
  plant_id: str = ""  # which one
  _recorder: Any = None  # a `real.recorder.recorder.Recorder`

  def __init__(self, scene: Any, settings: EvaluationSettings):
    """Notes what is evaluated.

    Args:
      scene: An opened bundle.
      settings: The evaluation's protocol and perturbation, and what the kind of plant reads.
    """
    self.scene, self.protocol, self.perturbation = scene, settings.protocol, settings.perturb
    self.conditions = conditions_of(settings)

  @property
  @abc.abstractmethod
  def environment(self) -> dm_env.Environment:
    """The environment with the policy's observations and actions."""

  @property
  @abc.abstractmethod
  def goal(self) -> np.ndarray:
    """Where robot or ball shall get to in this trial [2] [m]."""

  @property
  @abc.abstractmethod
  def time_limit(self) -> float:
    """Length of an episode [s]."""

  @abc.abstractmethod
  def start(self, trial: Trial) -> dm_env.TimeStep:
    """Sets a trial up."""

  @abc.abstractmethod
  def step(self, action: np.ndarray) -> dm_env.TimeStep:
    """Takes one control step."""

  @abc.abstractmethod
  def sight(self) -> Sight:
    """Returns the observer's present view of the robot."""

  def reached(self, sight: Sight) -> bool | None:
    """Returns whether the goal is reached; None where it is not measured."""
    if self.protocol == BALL:
      if sight.ball is None:
        return None
      half = protocols.CELL_SIZE / 2
      return bool((np.abs(sight.ball - self.goal) <= half).all())
    if sight.pose is None:
      return None
    return bool(np.hypot(*(self.goal - sight.pose.xy)) <= rewards.SUCCESS_DISTANCE)

  def stopped(self) -> str:
    """Returns why the plant itself ended the episode; empty if it did not."""
    return ""

  def judge(self) -> tuple[str, float | None, str] | None:
    """Returns a person's verdict (outcome, time [s], detail); None where the poses suffice."""
    return None

  @abc.abstractmethod
  def close(self) -> None:
    """Ends the plant."""

  def check_recording(self) -> None:
    """Raises OSError, after `close`, if what was to be recorded is not whole."""
    if self._recorder is not None:
      self._recorder.raise_failure()


def conditions_of(settings: EvaluationSettings) -> str:
  """Returns what the settings change besides policy, plant, protocol and what is disturbed.

  Episodes under other conditions are others, also where they share a folder.

  Returns:
    Scene, effects, length of an episode, drawn actions, errors of placing and swapped parts, in
    words with digests of the files; empty for what the paper evaluates, in the built-in room.
  """
  found = [] if settings.scene is None else [scene_condition(settings.scene)]
  if settings.effects is not None and settings.plant == "sim":
    found.append(f"effects {files.hash_path(settings.effects)[:8]}")
  if settings.time_limit is not None:
    found.append(f"at most {settings.time_limit:g} s")
  if settings.stochastic:
    # In simulation the plant is named by the same seed.
    other = settings.seed != EvaluationSettings.seed and settings.plant != "sim"
    found.append(f"drawn actions of seed {settings.seed}" if other else "drawn actions")
  if settings.plant == "virtual" and settings.placing != EvaluationSettings.placing:
    found.append("placed within {:g} m, {:g} rad".format(*settings.placing))
  if settings.swap:
    found.append("swapped " + " and ".join(sorted(set(settings.swap))))
  return ", ".join(found)


_SCENE = "scene "


def scene_condition(folder: Path | None) -> str:
  """Returns what conditions say of a scene; empty for the built-in room."""
  if folder is None:
    return ""
  digest = files.hash_path(Path(folder) / "scene.json")
  return f"{_SCENE}{Path(folder).resolve().name} ({digest[:8]})"


def is_in_scene(conditions: str, scene: str) -> bool:
  """Returns whether conditions are of a scene, by its own condition."""
  if not scene:
    return not conditions.startswith(_SCENE)
  return conditions == scene or conditions.startswith(f"{scene}, ")


def trials(protocol: str) -> tuple[tuple[str, Trial], ...]:
  """Returns the trials of a protocol with their groups, in the order they are run.

  Raises:
    ValueError: Unknown protocol.
  """
  if protocol not in PROTOCOLS:
    raise ValueError(errors.unknown_name("protocol", protocol, PROTOCOLS))
  return tuple((_group(protocol, trial), trial) for trial in PROTOCOLS[protocol]())


def _group(protocol: str, trial: Trial) -> str:
  if isinstance(trial, BallTrial):
    return trial.setting
  if protocol == protocols.GAIN:  # by the camera's own number
    return f"gain {round(trial.camera_gain * protocols.DEFAULT_GAIN)}"
  return protocol


def keep_clear(scene: Any, starts: np.ndarray) -> np.ndarray:
  """Returns where nothing may be put: goals and starts [N, 2] [m]."""
  return np.concatenate([np.asarray(scene.goals, np.float64).reshape(-1, 2), starts])


def make_intruder(plant: Plant, starts: np.ndarray) -> perturbations.Intruder | None:
  """Returns the body that the plant's perturbation puts into its scene, if any."""
  clear = keep_clear(plant.scene, starts)
  return perturbations.make_intruder(plant.perturbation, plant.scene, keep_clear=clear)
