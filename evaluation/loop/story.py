"""Closes the loop with a policy: it fails on a robot, the data say why, it is trained on.

Stages, each of which leaves files and is not repeated: trials before, recordings, finding, trials
in the simulation with the effects put in, training, trials after. A policy that lost no success is
not trained: there is nothing to bring back.
"""

import functools
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from nerf2real.agents.supervision.training import Scripts
from nerf2real.core.geometry.camera_info import read_camera_info
from nerf2real.core.serialization import to_plain, write_json
from nerf2real.evaluation import side_by_side
from nerf2real.evaluation.episodes import OUTCOMES, Episode, Store
from nerf2real.evaluation.loop import naming, training, trials
from nerf2real.evaluation.loop.comparing import Comparison, compare
from nerf2real.evaluation.loop.naming import Named
from nerf2real.evaluation.loop.robot import machines, recording
from nerf2real.evaluation.loop.sessions import Cooled
from nerf2real.evaluation.loop.settings import LoopSettings, claim, policy_folder
from nerf2real.evaluation.loop.training import Trained
from nerf2real.evaluation.loop.trials import Condition, Say, Tally, tally
from nerf2real.real.loading import Connection
from nerf2real.real.virtual.camera import LENS
from nerf2real.suite.scene import open_scene

HEALTHY, BEFORE, AFTER = "robot as it was", "robot before", "robot after"
NOMINAL, WITH_EFFECTS = "simulation, nominal", "simulation with the effects"
TRAINED = "simulation with the effects, trained on"
_ORDER = (HEALTHY, BEFORE, NOMINAL, WITH_EFFECTS, TRAINED, AFTER)  # of what is told
_TIMES = "times.json"


class Story(NamedTuple):
  """What a loop gave."""

  settings: LoopSettings
  episodes: dict[str, list[Episode]]  # by condition
  named: Named
  trained: Trained | None  # None: nothing was named, or nothing lost: the policy stays
  comparison: Comparison | None  # with what was hidden; None: of a real robot nobody knows
  cooled: dict[str, list[Cooled]]  # sessions that heat ended, by condition
  times: dict[str, float]  # s of each stage

  @property
  def tallies(self) -> dict[str, Tally]:
    """Counts of every condition."""
    return {name: tally(name, found) for name, found in self.episodes.items()}


def close(settings: LoopSettings, scripts: Scripts, say: Say) -> Story:
  """Closes the loop, going on where an earlier run stopped; writes loop.json.

  Args:
    settings: Of the loop.
    scripts: Of the distillation's learner and collectors.
    say: Called with a line at a time; what is hidden is not among them.

  Raises:
    ValueError: The settings cannot be run, or the folder is another loop's.
    RuntimeError: Robot, recorder or training did not keep up.
  """
  hidden = machines.hidden_effects(settings.hidden, settings.seed)
  policy = policy_folder(settings)
  claim(settings)
  scene = open_scene(settings.scene)
  store = Store(settings.out)
  stages = _Stages(settings.out / _TIMES)
  found: dict[str, list[Episode]] = {}
  virtual = settings.robot == recording.VIRTUAL
  processes = settings.processes if virtual else 1  # a person attends to a robot alone

  def run(*conditions: Condition) -> None:
    functions = [functools.partial(trials.run_apart, settings, c, store) for c in conditions]
    try:
      ran = side_by_side.run(functions, processes=processes, say=say)
    finally:
      store.read()
    for condition, (episodes, seconds) in zip(conditions, ran, strict=True):
      found[condition.name] = episodes
      stages.add(condition.name, seconds)
      say(f"{condition.name}: {tally(condition.name, episodes)}")

  before = Condition(name=BEFORE, policy=policy, altered=hidden)
  nominal = Condition(name=NOMINAL, policy=policy, simulated=True)
  healthy = [Condition(name=HEALTHY, policy=policy)] if virtual and hidden else []
  run(*healthy, before, nominal)
  if virtual and not hidden:  # the same robot: its trials are run once
    found[HEALTHY] = found[BEFORE]
  with stages.timed("recording"):
    reference = _record(settings, hidden, say)
  on_robot = [HEALTHY, BEFORE] if healthy else [BEFORE]
  walked = {name: trials.walked(settings, name, found[name], store) for name in on_robot}
  say("identifying from the motions, and from the trials' walks")
  with stages.timed("identification"):
    named = naming.name(
      settings.out / "identified",
      settings.out / "stand",
      reference,
      walked=walked[BEFORE],
      walked_before=walked.get(HEALTHY),
    )
  say(f"verdict: {named.verdict}: {', '.join(e.kind for e in named.named) or 'nothing'}")
  trained: Trained | None = None
  after = policy
  last: list[Condition] = []
  if named.named or named.forces:
    effects = named.entering_path
    run(Condition(name=WITH_EFFECTS, policy=policy, simulated=True, effects=effects))
    if lost({name: tally(name, episodes) for name, episodes in found.items()}) > 0:
      with stages.timed("training"):
        trained = training.train(settings, policy, effects, scene=scene, scripts=scripts)
      after = trained.policy
      last.append(Condition(name=TRAINED, policy=after, simulated=True, effects=effects))
    else:
      say("no success was lost: the policy stays")
  run(*last, Condition(name=AFTER, policy=after, altered=hidden))
  comparison = None
  if virtual:
    comparison = compare(hidden, named.named, named.in_reference)
  found = {name: found[name] for name in _ORDER if name in found}
  cooled = {name: trials.session(settings, name).cooled for name in found}
  story = Story(settings, found, named, trained, comparison, cooled, stages.seconds)
  write_json(settings.out / "loop.json", summary(story))
  return story


def _record(settings: LoopSettings, hidden: Any, say: Say) -> Path | None:
  """Records the stand, and the virtual robot's before where no reference is given.

  Returns:
    The folder of the reference; None: there is none.
  """
  seconds, out = settings.seconds, settings.out
  wanted = [out / "stand" / f"{name}.mcap" for name in (*_logs(), recording.FLOOR)]
  if settings.robot != recording.VIRTUAL:
    lens = None if settings.lens is None else read_camera_info(settings.lens)
    camera = None if lens is None else settings.camera
    connection = Connection(port=settings.robot, camera=camera, offsets=settings.offsets)
    recording.record_stand(out / "stand", connection, None, seconds=seconds, lens=lens)
    recording.record_floor(out / "stand", connection, None)
    return settings.reference
  age = trials.session(settings, BEFORE).seconds / 2  # between the trials: what sags, is half way
  given = settings.reference
  recordings = [(out / "stand", hidden, age, machines.noise_beside(given))]
  if given is None:
    recordings.append((out / "reference", (), 0.0, 1))
  for folder, altered, used, noise in recordings:
    if all((folder / path.name).exists() for path in wanted):
      continue
    say(f"recording the motions of the stand in {folder}")
    made = functools.partial(machines.virtual_robot, settings.seed, altered, age=used, noise=noise)
    with made(films=True) as (link, robot):
      recording.record_stand(folder, link, robot, seconds=seconds, lens=LENS)
    with made() as (link, robot):
      recording.record_floor(folder, link, robot)
  return given or out / "reference"


def _logs() -> tuple[str, ...]:
  return (*recording.TRAIN, *recording.HELD)


def summary(story: Story) -> dict[str, Any]:
  """Returns a loop as plain values: counts, finding, training, what was hidden."""
  named = story.named
  return {
    "settings": to_plain(story.settings),
    "success": {name: to_plain(found) for name, found in story.tallies.items()},
    "verdict": named.verdict,
    "effects": [to_plain(effect) for effect in named.entering],
    "left_out": [f"{e.kind} at {e.target or 'all'}" for e in named.left_out],
    "share_explained": named.share,
    "error_held_rad": named.content["error"]["held"],
    "notes": named.notes,
    "lost": lost(story.tallies),
    "trained": None if story.trained is None else to_plain(story.trained),
    "hidden": None if story.comparison is None else to_plain(story.comparison),
    "recovered": recovered(story),
    "cooled": {name: to_plain(ended) for name, ended in story.cooled.items() if ended},
    "gap_to_robot": {name: to_plain(found) for name, found in gaps(story).items()},
    "recorded_s": story.settings.seconds * len(_logs()),
    "seconds": {name: round(value, 1) for name, value in story.times.items()},
  }


class Gap(NamedTuple):
  """How far a simulation's trials are from the robot's before."""

  success: float  # share in the simulation less the robot's
  outcomes: float  # total variation distance between how the trials ended, 0 to 1


def gaps(story: Story) -> dict[str, Gap]:
  """Returns the gaps between simulation and robot, without and with the effects."""
  robot = story.tallies[BEFORE]

  def gap(found: Tally) -> Gap:
    kinds = [
      abs(found.outcomes[o] / found.trials - robot.outcomes[o] / robot.trials) for o in OUTCOMES
    ]
    return Gap(found.share - robot.share, sum(kinds) / 2)

  tallies = story.tallies
  return {name: gap(tallies[name]) for name in (NOMINAL, WITH_EFFECTS) if name in tallies}


def lost(tallies: Mapping[str, Tally]) -> float:
  """Returns the success that a robot lost: as it was less before.

  Of a real robot nobody knows how it was: there it is the nominal simulation's less before.
  """
  known = tallies[HEALTHY] if HEALTHY in tallies else tallies[NOMINAL]
  return known.share - tallies[BEFORE].share


def recovered(story: Story) -> float | None:
  """Returns the share of the lost success that came back; None where none was lost."""
  tallies = story.tallies
  if HEALTHY not in tallies or lost(tallies) <= 0:
    return None
  return (tallies[AFTER].share - tallies[BEFORE].share) / lost(tallies)


class _Stages:
  """Times of stages, added up over the runs of a loop."""

  def __init__(self, path: Path):
    self._path = path
    self.seconds: dict[str, float] = json.loads(path.read_text()) if path.exists() else {}

  @contextmanager
  def timed(self, name: str) -> Iterator[None]:
    """Adds the time of a block to a stage."""
    begun = time.monotonic()
    try:
      yield
    finally:
      self.add(name, time.monotonic() - begun)

  def add(self, name: str, seconds: float) -> None:
    """Adds a time [s] to a stage."""
    self.seconds[name] = self.seconds.get(name, 0.0) + seconds
    write_json(self._path, self.seconds)
