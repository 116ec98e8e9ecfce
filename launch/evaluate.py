"""Evaluates a policy as the paper does, in simulation, on a virtual robot or on a robot.

Every run adds its episodes to a folder, from which one report is made: run it with `--plant sim`
and `--plant virtual` into the same folder for tables with both side by side. A run that was cut
short goes on where it stopped.

python launch/evaluate.py --policy gait --plant sim --protocol navigation --out out/evaluation
python launch/evaluate.py --policy runs/nav/policy/best --plant virtual --protocol navigation
python launch/evaluate.py --policy gait --plant robot --robot /dev/ttyUSB0 --camera 0 --dry-run
"""

# ruff: noqa: E402  (threads and GL are chosen before numpy and mujoco are imported)

import dataclasses
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
  os.environ.setdefault(_name, "1")
os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import tyro

from nerf2real.agents.dmpo import belief_plot, export
from nerf2real.evaluation import episodes, maps, plants, report, runner, tables
from nerf2real.evaluation.plants import Plant, Sight
from nerf2real.evaluation.policies import Belief, EvaluatedPolicy, GaitPolicy
from nerf2real.suite import loading

GAIT = "gait"
_HEAT_CELL = 0.05  # m


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Evaluates a policy as the paper does."""

  policy: str = GAIT
  """Folder of an exported policy, or "gait" for the scripted walker."""
  plant: Literal["sim", "virtual", "robot"] = "sim"
  """Where: the training simulation, a virtual robot in the true room, or a robot."""
  protocol: Literal["navigation", "ball", "gain"] = "navigation"
  """Which of the paper's evaluations: tables I, II and V."""
  perturb: Literal["none", "blocked_camera", "moved_object", "person"] = "none"
  """What is disturbed."""
  out: Path = Path("out/evaluation")
  """Folder of the episodes and the report."""
  scene: Path | None = None
  """Folder of a scene bundle; the built-in room if not given."""
  effects: Path | None = None
  """An effects.json for the simulation: what the nominal model lacks."""
  trials: int | None = None
  """Runs only the first trials of the protocol, spread over it; all if not given."""
  seed: int = 0
  """Seed of the simulation's episodes and of drawn actions."""
  robot_seed: int = 1
  """Which virtual robot: the seed of what is hidden in it."""
  stochastic: bool = False
  """Draws actions instead of taking the policy's mean."""
  camera_size: tuple[int, int] | None = None
  """Height and width of a picture that is taken even if the policy does not look at it."""
  robot: str = "/dev/ttyUSB0"
  """Serial port of the robot."""
  camera: str = "0"
  """The robot's camera: device number, file or URL."""
  offsets: Path | None = None
  """The robot's offset.yaml."""
  lens: Path | None = None
  """The camera's camera_info YAML of launch/calibrate_camera.py, for recordings on the robot."""
  record: bool = False
  """Records runs on the virtual robot and the robot as MCAP beside the report."""
  time_limit: float | None = None
  """Length of an episode [s]; the task's own if not given."""
  markdown: Path | None = None
  """Writes the tables of everything in the folder to a Markdown file, too."""
  dry_run: bool = False
  """Robot only: reads and asks everything, moves and keeps nothing; one trial without --trials."""


class LearnedPolicy:
  """An exported policy in an evaluation."""

  def __init__(self, folder: Path, *, seed: int, stochastic: bool):
    """Loads the policy.

    Args:
      folder: Of the exported policy.
      seed: Of drawn actions.
      stochastic: Whether to draw actions.

    Raises:
      ValueError: The folder holds none, or one of other observations.
    """
    self._loaded = export.load_policy(folder)
    if self._loaded.history != 1:
      raise ValueError(
        f"{folder} stacks {self._loaded.history} observations, expected 1: the suite's have a "
        "history of their own; train with history 1."
      )
    # The robot has no privileged observations, and the policy does not look at them.
    self._layout = dataclasses.replace(
      self._loaded.layout, privileged_names=(), privileged_sizes=()
    )
    self.name = folder.resolve().name
    if self.name in ("best", "newest", "policy"):
      self.name = f"{folder.resolve().parents[1 if self.name != 'policy' else 0].name}-{self.name}"
    self.policy_id = str(_digest(folder))
    shape = self._layout.image_shape
    self.image_size = None if shape is None else (shape[0], shape[1])
    self._seed, self._stochastic = seed, stochastic
    self.belief: Belief | None = None

  def reset(self, sight: Sight) -> None:
    """Begins an episode."""
    self._state = self._loaded.policy.initial_state()
    self._random = np.random.default_rng(self._seed)
    self.belief = None

  def act(
    self, observation: Mapping[str, np.ndarray], *, goal: np.ndarray, sight: Sight
  ) -> np.ndarray:
    """Returns the action [20]."""
    policy = self._loaded.policy
    flat = self._layout.flatten(observation)
    step = policy.step(flat.image, flat.state, self._state)
    self._state = step.state
    if policy.has_belief and step.embedding.size:
      self.belief = Belief(*policy.belief(step.embedding))
    action = step.mean
    if self._stochastic:
      noise = self._random.standard_normal(action.shape, dtype=np.float32)
      action = action + step.stddev * noise
    return np.clip(action, -1.0, 1.0)


def _digest(folder: Path) -> str:
  return str(json.loads((folder / "policy.json").read_text())["sha256"])[:12]


def load_policy(arguments: Arguments, scene: Any) -> EvaluatedPolicy:
  """Returns the policy that the arguments name."""
  if arguments.policy == GAIT:
    return GaitPolicy(scene, arguments.protocol)
  return LearnedPolicy(Path(arguments.policy), seed=arguments.seed, stochastic=arguments.stochastic)


def make_plant(arguments: Arguments, scene: Any, image_size: tuple[int, int] | None) -> Plant:
  """Returns the plant that the arguments name."""
  record = None
  if arguments.record and arguments.plant != "sim":
    record = _free_name(arguments.out / f"{arguments.plant}_{arguments.protocol}.mcap")
  if arguments.plant == "sim":
    from nerf2real.evaluation.simulated import SimulatedPlant

    return SimulatedPlant(
      scene,
      arguments.protocol,
      arguments.perturb,
      image_size=image_size,
      effects=arguments.effects,
      seed=arguments.seed,
      time_limit=arguments.time_limit,
    )
  if arguments.plant == "virtual":
    from nerf2real.evaluation.rehearsed import RehearsedPlant

    return RehearsedPlant(
      scene,
      arguments.protocol,
      arguments.perturb,
      image_size=image_size,
      robot_seed=arguments.robot_seed,
      time_limit=arguments.time_limit,
      record=record,
    )
  from nerf2real.evaluation.operated import OperatedPlant

  camera: Any = int(arguments.camera) if arguments.camera.isdigit() else arguments.camera
  return OperatedPlant(
    scene,
    arguments.protocol,
    arguments.perturb,
    robot=arguments.robot,
    camera=camera,
    image_size=image_size,
    time_limit=arguments.time_limit,
    record=record,
    offsets=arguments.offsets,
    lens=arguments.lens,
    dry_run=arguments.dry_run,
  )


def _free_name(path: Path) -> Path:
  """Returns the path, or one with a number behind it if that is taken."""
  number = 1
  found = path
  while found.exists():
    number += 1
    found = path.with_stem(f"{path.stem}_{number}")
  return found


def choose(listed: tuple[Any, ...], count: int | None) -> list[tuple[int, Any]]:
  """Returns trials with their indices: all, or `count` spread over them."""
  indices = range(len(listed))
  if count is not None and count < len(listed):
    indices = np.unique(np.linspace(0, len(listed) - 1, count).round().astype(int)).tolist()
  return [(int(index), listed[index]) for index in indices]


def draw_belief(moment: episodes.Moment, goal: tuple[float, float], floor: maps.Map) -> np.ndarray:
  """Draws what a policy believed over the map."""
  density = belief_plot.position_density(
    np.array(moment.logits),
    np.array(moment.means),
    np.array(moment.stddevs),
    extent=floor.extent,
    cell=_HEAT_CELL,
  )
  truth = None if moment.position is None else np.array(moment.position)
  return belief_plot.draw_heat_map(
    density,
    extent=floor.extent,
    truth=truth,
    target=np.array(goal),
    background=floor.background,
    pixels_per_cell=3,
  )


def _say(episode: episodes.Episode, number: int, count: int) -> None:
  took = f"{episode.time:.1f} s" if episode.time is not None else f"after {episode.duration:.1f} s"
  error = episode.localisation_error
  lost = "" if error is None else f", localisation error {error:.2f} m"
  detail = f" ({episode.detail})" if episode.detail else ""
  print(f"{number:3d}/{count} {episode.group}: {episode.outcome} {took}{detail}{lost}", flush=True)


def run(arguments: Arguments) -> Path | None:
  """Runs what is missing, writes the report and returns its path; None after a dry run.

  Raises:
    ValueError: A dry run of a plant that is no robot.
  """
  if arguments.dry_run:
    _dry_run(arguments)
    return None
  scene = loading.open_scene(arguments.scene)
  store = episodes.Store(arguments.out)
  path = arguments.out / "report.html"
  try:
    _run_trials(arguments, scene, store, arguments.trials)
  finally:
    if store.episodes:
      report.write(
        path,
        store.episodes,
        scene=scene,
        draw_belief=draw_belief,
        settings=dataclasses.asdict(arguments),
      )
  said = [*tables.paper_tables(store.episodes), tables.outcome_table(store.episodes)]
  text = "\n".join(tables.as_text(table) for table in said)
  print(f"\n{text}")
  if arguments.markdown is not None:
    arguments.markdown.write_text(text)
  return path


def _dry_run(arguments: Arguments) -> None:
  """Goes through trials on the robot without moving it; nothing of it is counted or kept."""
  if arguments.plant != "robot":
    raise ValueError(
      f"--dry-run with --plant {arguments.plant}: expected --plant robot; the others move nothing "
      "that could break."
    )
  scene = loading.open_scene(arguments.scene)
  with tempfile.TemporaryDirectory() as folder:
    _run_trials(arguments, scene, episodes.Store(Path(folder)), arguments.trials or 1)


def _run_trials(arguments: Arguments, scene: Any, store: episodes.Store, count: int | None) -> None:
  policy = load_policy(arguments, scene)
  image_size = policy.image_size or arguments.camera_size
  plant = make_plant(arguments, scene, image_size)
  try:
    runner.run_all(
      plant, policy, choose(plants.trials(arguments.protocol), count), store=store, report=_say
    )
  finally:
    plant.close()


def main() -> None:
  """Parses the command line and evaluates."""
  arguments = tyro.cli(Arguments, description=__doc__)
  try:
    path = run(arguments)
    print("dry run: nothing moved, nothing kept" if path is None else f"wrote {path}")
  except (ValueError, OSError, RuntimeError, EOFError) as error:
    sys.exit(f"error: {error}")
  except KeyboardInterrupt:
    sys.exit("\nstopped: the same command goes on from here")


if __name__ == "__main__":
  main()
