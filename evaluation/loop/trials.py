"""The trials of a loop: one protocol under several conditions, in one store of episodes.

A condition is a policy on a plant. All episodes of a loop are lines of one file, so that an
interrupted loop runs only what is missing.
"""

import contextlib
import dataclasses
import hashlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from nerf2real.core.intervals import Interval, clopper_pearson
from nerf2real.core.serialization import read_json, write_json
from nerf2real.evaluation import episodes, runner
from nerf2real.evaluation.episodes import Episode, Store
from nerf2real.evaluation.loop.robot import starts
from nerf2real.evaluation.loop.robot.starts import Walked
from nerf2real.evaluation.loop.settings import LoopSettings
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.making import free_name, make_plant
from nerf2real.evaluation.plants.plant import Plant
from nerf2real.evaluation.policies.learned import LearnedPolicy
from nerf2real.evaluation.policies.policy import EvaluatedPolicy, GaitPolicy, resolution
from nerf2real.evaluation.session import choose
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.virtual.undeclared import Undeclared
from nerf2real.suite.protocols import NAVIGATION
from nerf2real.suite.scene import open_scene

Say = Callable[[str], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Condition:
  """A policy on a plant."""

  name: str  # in words
  policy: Path | None  # folder of an exported policy; None: the scripted walker
  simulated: bool = False
  effects: Path | None = None  # effects.json in the simulation, drawn from its intervals
  altered: tuple[Undeclared, ...] = ()  # undeclared effects of the virtual robot


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tally:
  """How the trials of a condition went."""

  name: str
  trials: int
  successes: int
  low: float  # of the exact 95 % interval of success
  high: float
  outcomes: dict[str, int]  # by `episodes.OUTCOMES`

  @property
  def share(self) -> float:
    """Share of successes."""
    return self.successes / self.trials

  def __str__(self) -> str:
    """Returns the share with n and interval."""
    bounds = f"{100 * self.low:.0f} to {100 * self.high:.0f} %"
    return f"{100 * self.share:.0f} % ({self.successes} of {self.trials}; {bounds})"


def tally(name: str, found: Sequence[Episode]) -> Tally:
  """Returns the counts of episodes, with the exact interval of Clopper and Pearson (1934)."""
  successes = sum(episode.success for episode in found)
  interval = clopper_pearson(successes, len(found)) if found else Interval(0.0, 1.0)
  outcomes = {o: sum(e.outcome == o for e in found) for o in episodes.OUTCOMES}
  return Tally(
    name=name,
    trials=len(found),
    successes=successes,
    low=round(interval.low, 4),
    high=round(interval.high, 4),
    outcomes=outcomes,
  )


def load_policy(folder: Path | None, scene: Any) -> EvaluatedPolicy:
  """Returns the policy of a condition."""
  if folder is None:
    return GaitPolicy(scene, NAVIGATION)
  return LearnedPolicy(folder, seed=0, stochastic=False)


def run(
  settings: LoopSettings, condition: Condition, scene: Any, store: Store, say: Say
) -> list[Episode]:
  """Runs the trials of a condition that the store lacks; returns all of them.

  Runs on robots are recorded in the folder `trials`.
  """
  chosen = choose(plants.trials(NAVIGATION), settings.trials)
  policy = load_policy(condition.policy, scene)
  label = plant_label(settings, condition)
  setting = dataclasses.replace(_setting(policy, condition, settings), plant_id=label)
  wanted = {index for index, _ in chosen}

  def found() -> list[Episode]:
    kept = [e for e in store.episodes if e.setting == setting and e.index in wanted]
    return sorted(kept, key=lambda episode: episode.index)

  if len(found()) == len(chosen):
    return found()
  say(f"{condition.name}: {len(chosen) - len(found())} of {len(chosen)} trials to run")
  session = _Session(settings.out / "trials" / f"{_slug(condition.name)}.json")
  with contextlib.closing(_make_plant(settings, condition, scene, policy, session)) as plant:
    plant.plant_id = label
    robot = getattr(plant, "robot", None)  # a virtual one, whose battery is to go on
    begun = 0.0 if robot is None else robot.clock.now()

    def report(episode: Episode, number: int, count: int) -> None:
      if robot is not None:
        session.note(robot.clock.now() - begun)
      took = f"{episode.outcome} after {episode.duration:.1f} s"
      say(f"  {condition.name} {number}/{count}: {took}")

    runner.run_all(plant, policy, chosen, store=store, report=report)
  return found()


def run_apart(
  settings: LoopSettings, condition: Condition, store: Store, say: Say
) -> tuple[list[Episode], float]:
  """Runs the trials of a condition in a process of their own; returns them, and the time [s]."""
  begun = time.monotonic()
  return run(settings, condition, open_scene(settings.scene), store, say), time.monotonic() - begun


def walked(settings: LoopSettings, name: str, found: Sequence[Episode], store: Store) -> Walked:
  """Returns a condition's logs, and all its episodes in the order in which they ran."""
  same = [e for e in store.episodes if found and e.setting == found[0].setting]
  return Walked(starts.logs(settings.out / "trials", _slug(name)), tuple(same))


def plant_label(settings: LoopSettings, condition: Condition) -> str:
  """Returns which plant a condition's is; what is hidden in a robot is a digest alone."""
  if condition.simulated:
    if condition.effects is None:
      return "nominal"
    return f"effects {hashlib.sha256(condition.effects.read_bytes()).hexdigest()[:8]}"
  if settings.robot != "virtual":
    return settings.robot
  altered = hashlib.sha256(repr(condition.altered).encode()).hexdigest()[:8]
  return f"robot {settings.seed}" + (f", altered {altered}" if condition.altered else "")


def _setting(
  policy: EvaluatedPolicy, condition: Condition, settings: LoopSettings
) -> episodes.Setting:
  return episodes.Setting(
    policy=policy.name,
    policy_id=policy.policy_id,
    resolution=resolution(policy),
    plant="sim" if condition.simulated else _robot(settings),
    plant_id="",
    protocol=NAVIGATION,
    perturbation="none",
  )


def _make_plant(
  settings: LoopSettings, condition: Condition, scene: Any, policy: EvaluatedPolicy, session: Any
) -> Plant:
  name = "sim" if condition.simulated else _robot(settings)
  evaluation = EvaluationSettings(
    plant=name,
    scene=settings.scene,
    effects=condition.effects,
    robot=settings.robot,
    robot_seed=(settings.seed,),
    camera=settings.camera,
    offsets=settings.offsets,
    lens=settings.lens,
    time_limit=settings.time_limit,
    placing=(0.0, 0.0),  # the floor's slope and the walks are read from where trials begin
  )
  return make_plant(
    evaluation,
    scene,
    policy.image_size,
    trained_on=policy.trained_on,
    record=free_name(settings.out / "trials" / f"{_slug(condition.name)}.mcap"),
    draw_effects=condition.effects is not None,
    altered=condition.altered,
    session=session.seconds,
  )


def _robot(settings: LoopSettings) -> Literal["virtual", "robot"]:
  return "virtual" if settings.robot == "virtual" else "robot"


class _Session:
  """How long a condition's robot has been on: its battery goes on where an earlier run stopped."""

  def __init__(self, path: Path):
    self._path = path
    self.seconds = read_json(path, float) if path.exists() else 0.0
    self._before = self.seconds

  def note(self, seconds: float) -> None:
    """Notes the time of this run so far [s]."""
    self._path.parent.mkdir(parents=True, exist_ok=True)
    self.seconds = self._before + seconds
    write_json(self._path, round(self.seconds, 3))


def session_seconds(settings: LoopSettings, name: str) -> float:
  """Returns how long the robot of a condition has been on [s]."""
  return _Session(settings.out / "trials" / f"{_slug(name)}.json").seconds


def _slug(name: str) -> str:
  return "".join(c if c.isalnum() else "_" for c in name.lower()).strip("_")
