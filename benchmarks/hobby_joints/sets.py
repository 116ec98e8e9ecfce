"""Draws one set: a machine, what is wrong with it, and its logs; an effect grows until it shows."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.drive_axes.choosing import choose
from benchmarks.hobby_joints import following, motions, recording
from benchmarks.hobby_joints.effects import LAST, LIBRARY, OUTSIDE, Kind
from benchmarks.hobby_joints.machines import DAYS, PLANTS, Machine, copy_of, declared, on_paper
from benchmarks.hobby_joints.recording import Host, Recording
from benchmarks.servo_bench.sets import MIXES, Truth

Array = np.ndarray
Random = np.random.Generator
LEAST_RATIO = 2.0
"""Held-out error over the healthy machine's, both of the true constants."""
LEAST_CHANGE = 2.5e-3
"""rad, RMS of what an effect changes in held-out readings; of a jaw by its servo's angle."""
_ATTEMPTS = 12
"""Machines that are tried for an effect."""
_GROWTH = 0.25
"""Of an effect's size, from one trial to the next."""
_DAYS = 3
"""Since the references, where they are of another day."""
_STREAM = 52511
"""Sets these draws apart from another generator's of the same seed."""


@dataclasses.dataclass(frozen=True)
class Scene:
  """A healthy machine, its motions, and how it follows the held-out ones."""

  machine: Machine
  earlier: Machine
  """The same when the references were recorded."""
  paper: Machine
  host: Host
  commands: dict[str, Array]
  """By log, [M, n]."""
  seed: tuple[int, ...]
  """Of all that is random in a log."""
  right: dict[str, Array] = dataclasses.field(default_factory=dict)
  """Of held-out logs: the model with true constants and the usual latency, [N, n]."""
  healthy: dict[str, Recording] = dataclasses.field(default_factory=dict)


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
    plants: of PLANTS to draw from.
    kinds: of effects to draw from.
    reference: also write logs of the healthy machine.
    same_day: they are of the hour before: only what is random is another.

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
    faulty, host, entries, seen = _break(scene, chosen, random)
    if seen:
      break
  start = recording.EPOCH + 10 * 86_400 * index
  days = 0 if same_day else _DAYS
  errors = _write(pathlib.Path(folder), scene, faulty, host, start, days, reference)
  about = {"plant": scene.machine.plant, "effects": entries, "mix": mix}
  return Truth({**about, **errors, "below_floor": not seen})


def draw_scene(plant: str, random: Random, seed: tuple[int, ...], *, same_day: bool) -> Scene:
  """Returns a machine with host and motions, and how it follows the held-out ones."""
  paper = on_paper(plant, random)
  built = copy_of(paper, random)
  today = copy_of(built, random, DAYS)
  machine, host = built if same_day else today, recording.draw_host(len(paper.joints), random)
  commands = {}
  for part, of in (("train", motions.TRAIN), ("held", motions.HELD)):
    for name, motion in of.items():
      times = recording.command_times(host, random.uniform(9.0, 13.5))
      goals = [motion(times, where, random) for where in machine.ranges]
      commands[f"{part}_{name}"] = np.stack(goals, 1)
  scene = Scene(machine, built, paper, host, commands, seed)
  healthy = {name: record(scene, machine, host, name) for name in commands if name[:4] == "held"}
  true, late = declared(machine), recording.lateness(host)
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
) -> tuple[Machine, Host, list[dict[str, Any]], bool]:
  """Returns the machine with effects, their entries, and whether each of them alone is seen."""
  machine, host, entries, all_seen = scene.machine, scene.host, [], True
  for name, kind in kinds.items():
    size, shape = random.uniform(), random.random(4)
    joint = int(random.integers(len(machine.joints)))
    if name in LAST:
      joint = len(machine.joints) - 1
    while True:
      alone, listener, _ = kind.apply(scene.machine, scene.host, joint, size, shape)
      seen = _visible(scene, alone, listener)
      if seen or size >= 1.0:
        break
      size = min(size + _GROWTH, 1.0)
    all_seen &= seen
    machine, host, parameters = kind.apply(machine, host, joint, size, shape)
    place = {"joint": machine.joints[joint] if kind.joint else None}
    if name == "payload":
      place["body"] = f"{place['joint']}_link"
    values = {key: float(value) for key, value in parameters.items()}
    entries.append({"kind": name, **place, **values})
  return machine, host, entries, all_seen


def _visible(scene: Scene, machine: Machine, host: Host) -> bool:
  """Returns whether held-out readings, as they are dated, tell a machine from the healthy one."""
  logs = {name: record(scene, machine, host, name) for name in scene.healthy}
  ratio = _mean_error(scene.right, scene, logs) / _mean_error(scene.right, scene, scene.healthy)
  before = {name: log.position for name, log in scene.healthy.items()}
  change = _mean_error(before, scene, logs) / scene.machine.radius[0]
  return ratio >= LEAST_RATIO and change >= LEAST_CHANGE


def _mean_error(courses: dict[str, Array], scene: Scene, logs: dict[str, Recording]) -> float:
  """Returns the mean RMS error over logs, against courses at the times of the healthy ones."""
  errors = [
    following.error(following.at(log.stamp, scene.healthy[name].time, courses[name]), log.position)
    for name, log in logs.items()
  ]
  return float(np.mean(errors))


def _write(
  folder: pathlib.Path,
  scene: Scene,
  faulty: Machine,
  host: Host,
  start: int,
  days: int,
  reference: bool,
) -> dict[str, float]:
  """Writes model and logs; returns the errors that the answer has."""
  folder.mkdir(parents=True, exist_ok=True)
  xml, joints = declared(scene.paper), scene.machine.joints
  (folder / "model.xml").write_text(xml)
  held = {}
  for number, name in enumerate(scene.commands):
    log = record(scene, faulty, host, name)
    # A log every ten minutes; on one day the references end half an hour before.
    today = start + days * 86_400 + 600 * number + 3_000
    recording.write(folder / f"{name}.mcap", log, host, joints, today)
    if name in scene.healthy:
      held[name] = log
    elif reference:
      before = record(scene, scene.earlier, scene.host, name, reference=True)
      path = folder / f"{name.replace('train', 'reference')}.mcap"
      recording.write(path, before, scene.host, joints, start + 600 * number)
  model = {
    name: following.follow(xml, log.sent, log.commands, log.time)
    for name, log in scene.healthy.items()
  }
  wrong, healthy = (_mean_error(scene.right, scene, logs) for logs in (held, scene.healthy))
  return {
    "error_ratio": round(wrong / healthy, 3),
    "held_error": _mean_error(model, scene, held),
    "healthy_held_error": _mean_error(model, scene, scene.healthy),
    "healthy_error_true_constants": healthy,
  }
