"""Draws one set: a bench, what is wrong with it, and its logs; an effect grows until it shows."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.servo_bench import bench as benches
from benchmarks.servo_bench import following, motions, motor, recording
from benchmarks.servo_bench.effects import LIBRARY, OUTSIDE, Kind, Machine
from benchmarks.servo_bench.recording import Recording

Array = np.ndarray
Random = np.random.Generator

MIXES = {"single": 0.5, "pair": 0.2, "outside": 0.15, "healthy": 0.15}
"""Shares in the mix `all`."""
LEAST_RATIO = 2.5
"""Held-out error over the healthy machine's, both with the true constants, that is clearly seen;
chosen: a quarter above the 2 that the first generator calls the floor."""
LEAST_CHANGE = 3e-3
"""rad, RMS of what an effect changes in the held-out readings; two steps of the usual encoder."""
_ATTEMPTS = 25
"""Benches that are tried for an effect."""
_GROWTH = 0.2
"""Of an effect's size, from one trial to the next."""
_DAYS = 3
"""Since the references, where they are of another day."""
_STREAM = 77003
"""Sets these draws apart from another generator's of the same seed."""


@dataclasses.dataclass(frozen=True)
class Truth:
  """What a set holds."""

  answer: dict[str, Any]
  """Its entry in answers.json."""


@dataclasses.dataclass(frozen=True)
class _Scene:
  """A healthy machine, its motions, and what it does in the held-out ones."""

  machine: Machine
  reference: Machine
  """The same on an earlier day."""
  commands: dict[str, Array]
  """By log: `train_*`, `held_*`; [M] rad."""
  seed: tuple[int, ...]
  """Of all that is random in a log."""
  right: dict[str, following.Course]
  """Of the held-out logs: the declared model with the true constants and latency."""
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
    plants: of `bench.PLANTS` to draw from.
    kinds: of effects to draw from.
    reference: also write logs of the healthy machine on another day.
    same_day: they are of the same day: only the noise is another.

  Raises:
    ValueError: a plant or kind that is not there, or none that fits the mix.
  """
  random = np.random.default_rng([_STREAM, seed, index])
  if mix == "all":
    mix = str(random.choice(list(MIXES), p=list(MIXES.values())))
  names = _choose(mix, plants or benches.PLANTS, kinds, random)
  kind_of = {**LIBRARY, **OUTSIDE}
  where = [
    plant
    for plant in (plants or benches.PLANTS)
    if all(plant in kind_of[name].plants for name in names)
  ]
  seen, seeds = False, (_STREAM, seed, index)
  for attempt in range(_ATTEMPTS):
    scene = _draw_scene(str(random.choice(where)), random, (*seeds, attempt), same_day=same_day)
    faulty, entries, seen = _break(scene, {name: kind_of[name] for name in names}, random)
    if seen:
      break
  days = 0 if same_day else _DAYS
  answer = _write(
    pathlib.Path(folder), scene, faulty, index=index, reference=reference, days_after=days
  )
  return Truth(
    {
      "plant": scene.machine.paper.plant,
      "effects": entries,
      "mix": mix,
      **answer,
      "below_floor": not seen,
    }
  )


def _choose(
  mix: str, plants: Sequence[str], kinds: Sequence[str] | None, random: Random
) -> list[str]:
  """Returns the kinds of a set's effects."""
  unknown = set(plants) - set(benches.PLANTS) | set(kinds or ()) - {*LIBRARY, *OUTSIDE}
  if unknown:
    raise ValueError(
      f"Found {sorted(unknown)}, expected plants of {benches.PLANTS} and kinds of"
      f" {[*LIBRARY, *OUTSIDE]}."
    )
  if mix == "healthy":
    return []
  source = OUTSIDE if mix == "outside" else LIBRARY
  fitting = [
    name
    for name, kind in source.items()
    if (not kinds or name in kinds) and set(kind.plants) & set(plants)
  ]
  first = str(random.choice(fitting)) if fitting else ""
  if mix != "pair":
    chosen = [first] if fitting else []
  else:
    others = [name for name in fitting if _together(source, first, name, plants)]
    chosen = [first, str(random.choice(others))] if others else []
  if not chosen:
    raise ValueError(f"Found no kinds for the mix {mix!r} among {kinds} on {plants}; name others.")
  return chosen


def _together(source: dict[str, Kind], first: str, other: str, plants: Sequence[str]) -> bool:
  a, b = source[first], source[other]
  return a.group != b.group and bool(set(a.plants) & set(b.plants) & set(plants))


def _draw_scene(plant: str, random: Random, seed: tuple[int, ...], *, same_day: bool) -> _Scene:
  paper = benches.on_paper(plant, random)
  copy = benches.copy_of(paper, random)
  host = recording.draw_host(paper.bench.motor, random)
  today = benches.another_day(copy, random)
  machine = Machine(paper, copy if same_day else today, host)
  reach = motions.Reach(1.0, random.uniform(0.5, 0.75) * motor.no_load_speed(paper.bench.motor))
  commands = {
    f"{part}_{name}": motion(recording.command_times(host, duration), reach, random)
    for part, motions_of in (("train", motions.TRAIN), ("held", motions.HELD))
    for name, (motion, duration) in motions_of.items()
  }
  true = benches.declared(paper, machine.bench)
  scene = _Scene(machine, Machine(paper, copy, host), commands, seed, {}, {})
  healthy = {name: _record(scene, machine, name) for name in commands if name.startswith("held")}
  right = {
    name: following.follow(true, log.command_time, log.command, recording.lateness(host))
    for name, log in healthy.items()
  }
  return dataclasses.replace(scene, healthy=healthy, right=right)


def _record(scene: _Scene, machine: Machine, name: str, *, reference: bool = False) -> Recording:
  """Returns a log by its name; what is random in it is the same whatever the effect."""
  random = np.random.default_rng([*scene.seed, list(scene.commands).index(name), reference])
  return recording.record(machine.bench, machine.host, scene.commands[name], random)


def _break(
  scene: _Scene, kinds: dict[str, Kind], random: Random
) -> tuple[Machine, list[dict[str, Any]], bool]:
  """Returns the machine with effects, their entries, and whether each of them alone is seen."""
  machine, entries, all_seen = scene.machine, [], True
  for name, kind in kinds.items():
    size, shape = random.uniform(), random.random(4)
    while True:
      alone, _ = kind.apply(scene.machine, size, shape)
      seen = _visible(scene, alone)
      if seen or size >= 1.0:
        break
      size = min(size + _GROWTH, 1.0)
    all_seen &= seen
    machine, parameters = kind.apply(machine, size, shape)
    entries.append({"kind": name, "joint": benches.JOINT if kind.joint else None, **parameters})
  return machine, entries, all_seen


def _visible(scene: _Scene, machine: Machine) -> bool:
  """Returns whether held-out readings tell a machine from the healthy one."""
  logs = {name: _record(scene, machine, name) for name in scene.healthy}
  ratio = _mean_error(scene.right, logs) / _mean_error(scene.right, scene.healthy)
  changes = [
    np.interp(scene.healthy[name].time, log.stamp, log.angle) - scene.healthy[name].angle
    for name, log in logs.items()
  ]
  change = float(np.sqrt(np.mean(np.concatenate(changes) ** 2)))
  return ratio >= LEAST_RATIO and change >= LEAST_CHANGE


def _mean_error(courses: dict[str, following.Course], logs: dict[str, Recording]) -> float:
  return float(np.mean([following.error(courses[name], log) for name, log in logs.items()]))


def _write(
  folder: pathlib.Path,
  scene: _Scene,
  faulty: Machine,
  *,
  index: int,
  reference: bool,
  days_after: int,
) -> dict[str, float]:
  """Writes model and logs; returns the errors that the answer has."""
  folder.mkdir(parents=True, exist_ok=True)
  xml = benches.declared(scene.machine.paper)
  (folder / "model.xml").write_text(xml)
  logs = {name: _record(scene, faulty, name) for name in scene.commands}
  start = recording.EPOCH + 10 * 86_400 * index
  for number, (name, log) in enumerate(logs.items()):
    # A bench is used every quarter of an hour or so; on one day the healthy one at the same times.
    today = start + days_after * 86_400 + 900 * number
    recording.write(folder / f"{name}.mcap", log, faulty.host, start=today)
    if reference and name.startswith("train"):
      before = _record(scene, scene.reference, name, reference=True)
      path = folder / f"{name.replace('train', 'reference')}.mcap"
      recording.write(path, before, scene.reference.host, start=start + 900 * number)
  declared = {
    name: following.follow(xml, log.command_time, log.command)
    for name, log in scene.healthy.items()
  }
  held = {name: logs[name] for name in scene.healthy}
  errors = [_mean_error(scene.right, of) for of in (held, scene.healthy)]
  return {
    "error_ratio": round(errors[0] / errors[1], 3),
    "held_error": _mean_error(declared, held),
    "healthy_held_error": _mean_error(declared, scene.healthy),
    "healthy_error_true_constants": errors[1],
  }
