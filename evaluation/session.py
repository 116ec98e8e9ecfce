"""An evaluation: settings in, missing trials run on a plant, one report out.

Every evaluation adds its episodes to a folder, from which one report is made. One that was cut
short goes on where it stopped.
"""

import contextlib
import dataclasses
import functools
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import dm_env
import numpy as np

from nerf2real.core.files import write_atomically
from nerf2real.core.folder_lock import lock_folder
from nerf2real.evaluation import episodes, runner, side_by_side
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants.making import free_name, make_plant
from nerf2real.evaluation.plants.plant import Plant
from nerf2real.evaluation.policies.controls import under_control
from nerf2real.evaluation.policies.driving import density
from nerf2real.evaluation.policies.learned import LearnedPolicy
from nerf2real.evaluation.policies.names import WALKERS, policy_folder
from nerf2real.evaluation.policies.policy import EvaluatedPolicy, GaitPolicy
from nerf2real.evaluation.report import page as report
from nerf2real.evaluation.report import tables
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.suite.scene import open_scene

_FILMED = (60, 80)  # pixels of the robot's picture in a film, if its policy looks at none


def load_policy(settings: EvaluationSettings, scene: Any) -> EvaluatedPolicy:
  """Returns the policy that the settings name, with its observations falsified if they say so."""
  policy: EvaluatedPolicy
  if settings.policy in WALKERS:
    policy = GaitPolicy(scene, settings.protocol)
  else:
    folder = policy_folder(settings.policy, task=plants.TASKS[settings.protocol])
    policy = LearnedPolicy(folder, seed=settings.seed, stochastic=settings.stochastic)
  return under_control(policy, settings.control, scene=scene, protocol=settings.protocol)


def each_plant(settings: EvaluationSettings) -> list[EvaluationSettings]:
  """Returns the settings of every single plant that is evaluated on.

  Raises:
    ValueError: There is no virtual robot where one is wanted.
  """
  robots = [
    dataclasses.replace(settings, plant="virtual", robot_seed=(s,))
    for s in dict.fromkeys(settings.robot_seed)
  ]
  if settings.plant in ("virtual", "both") and not robots:
    raise ValueError("--robot-seed names no virtual robot: expected one or more seeds.")
  if settings.plant == "virtual":
    return robots
  if settings.plant == "both":
    return [dataclasses.replace(settings, plant="sim"), *robots]
  return [settings]


def choose(
  listed: tuple[Any, ...],
  count: int | None,
  *,
  repetition: int | None = None,
  group: str | None = None,
  indices: Sequence[int] = (),
) -> list[tuple[int, Any]]:
  """Returns trials with their indices: all, or `count` spread over them.

  Args:
    listed: Groups and trials of a protocol.
    count: How many; all if None.
    repetition: Of the starts; all if None.
    group: Of the trials; all if None.
    indices: Of the trials; all if there are none.

  Raises:
    ValueError: No start is repeated so often, there is no such group or trial, or none is of all.
  """
  known = sorted({trial.trial for _, trial in listed})
  if repetition is not None and repetition not in known:
    raise ValueError(f"--repetition {repetition}: expected one of {', '.join(map(str, known))}.")
  groups = dict.fromkeys(name for name, _ in listed)
  if group is not None and group not in groups:
    raise ValueError(f"--group {group}: expected one of {', '.join(groups)}.")
  beyond = [index for index in indices if not 0 <= index < len(listed)]
  if beyond:
    raise ValueError(f"--indices {beyond[0]}: expected 0 to {len(listed) - 1}.")
  chosen = [
    index
    for index, (name, trial) in enumerate(listed)
    if repetition in (None, trial.trial)
    and group in (None, name)
    and (not indices or index in indices)
  ]
  if not chosen:
    raise ValueError(
      f"Found no trial of --repetition {repetition}, --group {group} and --indices "
      f"{' '.join(map(str, indices))} together: leave one out."
    )
  if count is not None and count < len(chosen):
    spread = np.unique(np.linspace(0, len(chosen) - 1, count).round().astype(int))
    chosen = [chosen[place] for place in spread]
  return [(index, listed[index]) for index in chosen]


def _line(episode: episodes.Episode, number: int, count: int) -> str:
  took = f"{episode.time:.1f} s" if episode.time is not None else f"after {episode.duration:.1f} s"
  error = episode.localisation_error
  lost = "" if error is None else f", localisation error {error:.2f} m"
  detail = f" ({episode.detail})" if episode.detail else ""
  return f"{number:3d}/{count} {episode.group}: {episode.outcome} {took}{detail}{lost}"


def evaluate(settings: EvaluationSettings, say: Callable[[str], None]) -> Path | None:
  """Runs the trials that are missing and writes the report of all that were run.

  Args:
    settings: The evaluation.
    say: Called with a line after every episode, and with the tables at the end.

  Returns:
    The report's path; None after a dry run, which keeps nothing.

  Raises:
    FolderInUseError: Another process evaluates into the folder.
    ValueError: No trials or processes, a dry run that is of no robot, a film that is not of "sim",
      several processes where trials follow one another.
    RuntimeError: A process ended before its trials were over.
  """
  _check_processes(settings)
  if settings.trials is not None and settings.trials < 1:
    raise ValueError(f"--trials {settings.trials}: expected at least 1, or none for all.")
  if settings.video is not None:
    if settings.plant != "sim":
      raise ValueError(f"--video films --plant sim, found --plant {settings.plant}.")
    from nerf2real.suite.views.film import check_film

    check_film(settings.video)
  scene = open_scene(settings.scene)
  if settings.dry_run:
    _dry_run(settings, scene, say)
    return None
  with lock_folder(settings.out):
    return _evaluate(settings, scene, say)


def _evaluate(settings: EvaluationSettings, scene: Any, say: Callable[[str], None]) -> Path:
  store = episodes.Store(settings.out)
  if store.duplicates:
    say(f"left out {store.duplicates} episodes that {store.path} holds twice")
  path = settings.out / "report.html"
  try:
    _run_trials(settings, scene, store, say)
  finally:
    if store.episodes:
      report.write(
        path,
        store.episodes,
        scene=scene,
        condition=plants.scene_condition(settings.scene),
        settings=dataclasses.asdict(settings),
      )
  shown = [*tables.paper_tables(store.episodes), tables.outcome_table(store.episodes)]
  text = "\n".join(tables.as_text(table) for table in shown)
  say(f"\n{text}")
  if settings.markdown is not None:
    write_atomically(settings.markdown, text)
  return path


def _dry_run(settings: EvaluationSettings, scene: Any, say: Callable[[str], None]) -> None:
  """Goes through trials on the robot without moving it; nothing of it is counted or kept."""
  if settings.plant != "robot":
    raise ValueError(
      f"--dry-run with --plant {settings.plant}: expected --plant robot; the others move nothing "
      "that could break."
    )
  with tempfile.TemporaryDirectory() as folder:
    single = dataclasses.replace(settings, trials=settings.trials or 1)
    _run_trials(single, scene, episodes.Store(Path(folder)), say)


@contextlib.contextmanager
def _filming(settings: EvaluationSettings, plant: Plant) -> Iterator[runner.Watch]:
  """Yields what films the episodes, or does nothing."""
  if settings.video is None:
    yield runner.unwatched
    return
  from nerf2real.suite.views.film import Film, describe, open_film

  with open_film(settings.video) as sink:
    environment: Any = plant.environment
    film = Film(environment, sink)

    def watch(timestep: dm_env.TimeStep, policy: EvaluatedPolicy) -> None:
      if timestep.first():
        film.restart()
      else:
        text = describe(settings.protocol, environment.task)
        film.add(timestep.observation, text, density=density(policy.belief, film.map_extent))

    yield watch


def _check_processes(settings: EvaluationSettings) -> None:
  count = settings.processes
  if count < 1:
    raise ValueError(f"--processes {count}: expected at least 1.")
  if count > 1 and (settings.plant == "robot" or settings.video is not None):
    what = "--plant robot" if settings.plant == "robot" else "--video"
    raise ValueError(f"--processes {count} with {what}: expected 1, for trials follow one another.")


def _run_trials(
  settings: EvaluationSettings, scene: Any, store: episodes.Store, say: Callable[[str], None]
) -> None:
  """Runs what is missing on every plant; processes share the trials of each."""
  singles = each_plant(settings)
  shares = settings.processes // math.gcd(settings.processes, len(singles))
  if shares == settings.processes == 1:
    for single in singles:
      _run_share(single, scene, store, say, (0, 1))
    return
  functions = [
    functools.partial(_run_apart, single, store, (k, shares))
    for single in singles
    for k in range(shares)
  ]
  try:
    side_by_side.run(functions, processes=settings.processes, say=say)
  finally:
    store.read()


def _run_apart(
  settings: EvaluationSettings,
  store: episodes.Store,
  share: tuple[int, int],
  say: Callable[[str], None],
) -> None:
  """Runs a share of a plant's trials in a process of its own, which adds to the store's file."""
  _run_share(settings, open_scene(settings.scene), store, say, share)


def _run_share(
  settings: EvaluationSettings,
  scene: Any,
  store: episodes.Store,
  say: Callable[[str], None],
  share: tuple[int, int],
) -> None:
  """Runs a share of the trials that are missing on one plant."""
  policy = load_policy(settings, scene)
  size = policy.image_size or settings.camera_size
  size = _FILMED if settings.video and size is None else size
  chosen = choose(
    plants.trials(settings.protocol),
    settings.trials,
    repetition=settings.repetition,
    group=settings.group,
    indices=settings.indices,
  )
  log = None
  if settings.record and settings.plant != "sim":
    name = f"{settings.plant}_{settings.protocol}" + (f"_share{share[0]}" if share[1] > 1 else "")
    log = free_name(settings.out / f"{name}.mcap")
  plant = make_plant(settings, scene, size, trained_on=policy.trained_on, record=log)
  say(f"{tables.PLANTS[plant.name]} ({plant.plant_id})")
  try:
    with _filming(settings, plant) as watch:
      runner.run_all(
        plant,
        policy,
        chosen,
        store=store,
        report=lambda *told: say(_line(*told)),
        watch=watch,
        share=share,
      )
  finally:
    plant.close()
  plant.check_recording()
