"""The trials of a loop: one protocol under several conditions, in one store of episodes.

A condition is a policy on a plant. All episodes of a loop are lines of one file, so that an
interrupted loop runs only what is missing.
"""

import contextlib
import dataclasses
import functools
import hashlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from nerf2real.core.intervals import Interval, clopper_pearson
from nerf2real.evaluation import episodes, runner
from nerf2real.evaluation.episodes import Episode, Store
from nerf2real.evaluation.loop.robot import starts
from nerf2real.evaluation.loop.robot.starts import Walked
from nerf2real.evaluation.loop.sessions import MOST_COOLED, Cooled, Session, overheated, until_hot
from nerf2real.evaluation.loop.settings import LoopSettings
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.making import free_name, make_plant
from nerf2real.evaluation.plants.plant import Plant
from nerf2real.evaluation.policies.learned import LearnedPolicy
from nerf2real.evaluation.policies.policy import EvaluatedPolicy, GaitPolicy, resolution
from nerf2real.evaluation.session import choose
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.safety.monitor import SafetyError
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

  Runs on robots are recorded in the folder `trials`. Where a joint of the virtual robot is so hot
  that a trial is stopped, or cannot begin, the trials after it go on with a cool one: a trial that
  begins a degree below the limit ends after a second, whatever the policy is.

  Raises:
    SafetyError: The robot is too hot all the same, or stopped for another reason.
  """
  simulated = condition.simulated and settings.simulated is not None
  count = settings.simulated if simulated else settings.trials
  chosen = choose(plants.trials(NAVIGATION), count)
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
  on_robot = session(settings, condition.name)
  for _ in range(MOST_COOLED + 1):
    done = len(found())
    with contextlib.closing(_make_plant(settings, condition, scene, policy, on_robot)) as plant:
      plant.plant_id, plant.conditions = label, ""  # the folder is of one scene and time limit
      report = _reporter(plant, condition, on_robot, say)
      run_all = functools.partial(runner.run_all, plant, policy, chosen, store=store, report=report)
      hot = until_hot(plant, run_all)
    if not hot or len(found()) == len(chosen):
      return found()
    on_robot.cool(Cooled(len(found()), hot))
    if len(found()) == done:
      break
    say(f"  {condition.name}: {hot}: a session with a cool robot begins")
  raise SafetyError(
    f"{condition.name}: found {hot} before trial {len(found()) + 1} of {len(chosen)}, expected a "
    f"robot that begins it (a cool one was taken {len(on_robot.cooled)} times): what is hidden is "
    "too much for it."
  )


def _reporter(
  plant: Plant, condition: Condition, on_robot: Session, say: Say
) -> Callable[[Episode, int, int], None]:
  """Returns what notes the session's time and says how a trial ended."""
  robot = getattr(plant, "robot", None)  # a virtual one, whose battery is to go on
  begun = 0.0 if robot is None else robot.clock.now()

  def report(episode: Episode, number: int, count: int) -> None:
    if robot is not None:
      on_robot.note(robot.clock.now() - begun)
    took = f"{episode.outcome} after {episode.duration:.1f} s"
    say(f"  {condition.name} {number}/{count}: {took}")
    if episode.outcome == episodes.STOPPED and overheated(plant):
      raise SafetyError(f"Torque was switched off: {overheated(plant)}.")

  return report


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
  settings: LoopSettings,
  condition: Condition,
  scene: Any,
  policy: EvaluatedPolicy,
  on_robot: Session,
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
    session=on_robot.seconds,
  )


def _robot(settings: LoopSettings) -> Literal["virtual", "robot"]:
  return "virtual" if settings.robot == "virtual" else "robot"


def session(settings: LoopSettings, name: str) -> Session:
  """Returns the session of a condition's robot."""
  return Session(settings.out / "trials", _slug(name))


def _slug(name: str) -> str:
  return "".join(c if c.isalnum() else "_" for c in name.lower()).strip("_")
