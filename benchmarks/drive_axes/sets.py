"""Draws one set: a machine, what is wrong with it, and its logs; an effect grows until it shows."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.drive_axes import following, motions, plants, recording
from benchmarks.drive_axes.choosing import choose
from benchmarks.drive_axes.effects import LIBRARY, OUTSIDE, Broken, Kind
from benchmarks.drive_axes.plants import PLANTS, Machine
from benchmarks.drive_axes.recording import Host, Recording
from benchmarks.servo_bench.sets import LEAST_RATIO, MIXES, Truth

Array = np.ndarray
Random = np.random.Generator

LEAST_CHANGE = {"lift": 1e-3, "swing": 3e-3, "planar": 3e-3}
"""m or rad, RMS of what an effect changes in the held-out readings."""
_ATTEMPTS = 25
"""Machines that are tried for an effect."""
_GROWTH = 0.2
"""Of an effect's size, from one trial to the next."""
_DAYS = 3
"""Since the references, where they are of another day."""
_STREAM = 41059
"""Sets these draws apart from another generator's of the same seed."""


@dataclasses.dataclass(frozen=True)
class Scene:
  """A healthy machine, its motions, and what it does in the held-out ones."""

  machine: Machine
  reference: Machine
  """The same on the day of the references."""
  paper: Machine
  """What is declared."""
  host: Host
  commands: dict[str, Array]
  """By log: `train_*`, `held_*`; [M, n]."""
  seed: tuple[int, ...]
  """Of all that is random in a log."""
  right: dict[str, Array]
  """Of the held-out logs: the declared model with the true constants and latency, [N, n]."""
  healthy: dict[str, Recording]


def make_set(
  folder: str | pathlib.Path,
  *,
  seed: int,
  index: int,
  mix: str = "all",
  plants: Sequence[str] | None = None,
  kinds: Sequence[str] | None = None,
  reference: bool = True,
  same_day: bool = False,
) -> Truth:
  """Writes a set and returns its truth; seed and index alone determine it, with mix and choices.

  Args:
    folder: where to.
    seed: of the collection.
    index: of the set.
    mix: `single`, `pair`, `outside`, `healthy`, or `all` for one of them.
    plants: of `plants.PLANTS` to draw from.
    kinds: of effects to draw from.
    reference: also write logs of the healthy machine.
    same_day: they are of the same day: only noise and phase differ.

  Raises:
    ValueError: a plant or kind that is not there, or none that fits the mix.
  """
  random = np.random.default_rng([_STREAM, seed, index])
  if mix == "all":
    mix = str(random.choice(list(MIXES), p=list(MIXES.values())))
  chosen, where = choose(mix, LIBRARY, OUTSIDE, random, known=PLANTS, among=plants, kinds=kinds)
  for attempt in range(_ATTEMPTS):
    numbers = (_STREAM, seed, index, attempt)
    scene = draw_scene(str(random.choice(where)), random, numbers, same_day=same_day)
    faulty, entries, seen = _break(scene, chosen, random)
    if seen:
      break
  start = recording.EPOCH + 10 * 86_400 * index
  errors = _write(pathlib.Path(folder), scene, faulty, start, 0 if same_day else _DAYS, reference)
  about = {"plant": scene.machine.plant, "effects": entries, "mix": mix}
  return Truth({**about, **errors, "below_floor": not seen})


def draw_scene(plant: str, random: Random, seed: tuple[int, ...], *, same_day: bool) -> Scene:
  """Returns a machine with its host and motions, and how it follows the held-out ones."""
  copy = plants.copy_of(plants.on_paper(plant, random), random)
  today = plants.copy_of(copy, random, plants.DAYS)
  paper = plants.as_declared(copy, random)
  machine, host = copy if same_day else today, recording.draw_host(random)
  commands = {}
  for part, motions_of in (("train", motions.TRAIN), ("held", motions.HELD)):
    for name, motion in motions_of.items():
      times = recording.command_times(host, random.uniform(10.5, 13.5))
      goals = [motion(times, reach, random) for reach in machine.reach]
      commands[f"{part}_{name}"] = np.stack(goals, 1)
  scene = Scene(machine, copy, paper, host, commands, seed, {}, {})
  healthy = {name: record(scene, machine, host, name) for name in commands if name[:4] == "held"}
  late, true = recording.lateness(host), plants.declared(machine)
  right = {
    name: following.follow(true, log.sent, log.commands, log.time, late)
    for name, log in healthy.items()
  }
  return dataclasses.replace(scene, healthy=healthy, right=right)


def record(
  scene: Scene, machine: Machine, host: Host, name: str, *, reference: bool = False
) -> Recording:
  """Returns a log by its name; what is random in it is the same whatever the effect."""
  random = np.random.default_rng([*scene.seed, list(scene.commands).index(name), reference])
  return recording.record(machine, host, scene.commands[name], random)


def _break(
  scene: Scene, kinds: dict[str, Kind], random: Random
) -> tuple[Broken, list[dict[str, Any]], bool]:
  """Returns the machine with effects, their entries, and whether each of them alone is seen."""
  faulty, entries, all_seen = Broken(scene.machine, scene.host, {}), [], True
  for name, kind in kinds.items():
    size, shape = random.uniform(), random.random(4)
    joint = int(random.integers(len(scene.machine.joints)))
    while True:
      alone = kind.apply(scene.machine, scene.host, joint, size, shape)
      seen = _visible(scene, alone)
      if seen or size >= 1.0:
        break
      size = min(size + _GROWTH, 1.0)
    all_seen &= seen
    faulty = kind.apply(faulty.machine, faulty.host, joint, size, shape)
    place: dict[str, str | None] = {"joint": None}
    if kind.joint:
      place = {"joint": scene.machine.joints[joint]}
    if name == "payload":
      place["body"] = f"{place['joint']}_link"
    entries.append({"kind": name, **place, **faulty.parameters})
  return faulty, entries, all_seen


def _visible(scene: Scene, broken: Broken) -> bool:
  """Returns whether held-out readings tell a machine from the healthy one."""
  logs = {name: record(scene, broken.machine, broken.host, name) for name in scene.healthy}
  ratio = _mean_error(scene.right, logs) / _mean_error(scene.right, scene.healthy)
  # The readings as they are dated: what a clock or a delay does is seen in them, too.
  changes = []
  for name, log in logs.items():
    healthy = scene.healthy[name]
    for now, before in zip(log.position.T, healthy.position.T, strict=True):
      changes.append(np.interp(healthy.time, log.stamp, now) - before)
  change = float(np.sqrt(np.mean(np.concatenate(changes) ** 2)))
  return ratio >= LEAST_RATIO and change >= LEAST_CHANGE[scene.machine.plant]


def _mean_error(courses: dict[str, Array], logs: dict[str, Recording]) -> float:
  """Returns the mean RMS error over logs, readings taken at the times of their stamps."""
  errors = []
  for name, log in logs.items():
    course = np.stack([np.interp(log.stamp, log.time, column) for column in courses[name].T], 1)
    errors.append(following.error(course, log.position))
  return float(np.mean(errors))


def _write(
  folder: pathlib.Path, scene: Scene, faulty: Broken, start: int, days: int, reference: bool
) -> dict[str, float]:
  """Writes model and logs; returns the errors that the answer has."""
  folder.mkdir(parents=True, exist_ok=True)
  xml, joints = plants.declared(scene.paper), scene.machine.joints
  (folder / "model.xml").write_text(xml)
  held = {}
  for number, name in enumerate(scene.commands):
    log = record(scene, faulty.machine, faulty.host, name)
    # Logs every ten minutes; on one day the references were an hour before.
    noon = start + days * 86_400 + 600 * number + 3_600
    recording.write(folder / f"{name}.mcap", log, faulty.host, joints, noon)
    if name in scene.healthy:
      held[name] = log
    elif reference:
      before = record(scene, scene.reference, scene.host, name, reference=True)
      path = folder / f"{name.replace('train', 'reference')}.mcap"
      recording.write(path, before, scene.host, joints, start + 600 * number)
  model = {
    name: following.follow(xml, log.sent, log.commands, log.time)
    for name, log in scene.healthy.items()
  }
  wrong, healthy = _mean_error(scene.right, held), _mean_error(scene.right, scene.healthy)
  return {
    "error_ratio": round(wrong / healthy, 3),
    "held_error": _mean_error(model, held),
    "healthy_held_error": _mean_error(model, scene.healthy),
    "healthy_error_true_constants": healthy,
  }
