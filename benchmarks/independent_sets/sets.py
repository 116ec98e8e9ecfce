"""Draws a set: a machine, what it lacks; writes its logs and model, returns the truth."""

import dataclasses
import pathlib
from typing import Any

import numpy as np

from benchmarks.independent_sets import (
  apparatus,
  declared,
  effects,
  machine,
  motions,
  recording,
  simulation,
  tracking,
)

MIXES = ("single", "pair", "outside", "healthy")
SHARES = (0.4, 0.15, 0.15, 0.3)
"""Of `MIXES` in the mix `all`."""
DURATION = 12.0
"""s of a log."""
SETTLING = 0.8
"""s before a log in which a machine comes to rest."""
DETECTABLE = 2.0
"""Largest error over the healthy machine's, both with the declared constants: less is not seen."""


@dataclasses.dataclass(frozen=True)
class Truth:
  """What is in a set; `answer` is its entry of answers.json."""

  mix: str
  answer: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Run:
  """One log to be made."""

  name: str
  machine: machine.Machine
  motion: str
  seed: tuple[int, ...]


def make_set(
  folder: pathlib.Path,
  *,
  seed: int,
  index: int,
  mix: str = "all",
  plants: tuple[str, ...] | None = None,
  kinds: tuple[str, ...] | None = None,
  reference: bool = True,
) -> Truth:
  """Draws the set `index` of a seed, writes `model.xml` and logs into a folder.

  Args:
    folder: where to; made if missing.
    seed: of the whole collection; seed and index alone decide a set.
    index: of the set.
    mix: one of `MIXES`, or "all".
    plants: kinds of apparatus to draw from; None: all.
    kinds: kinds of effect to draw from; None: all that the mix has.
    reference: also write three logs of the machine without effects, of another session.

  Raises:
    ValueError: no effect of `kinds` is in the mix on these plants.
  """
  rng = np.random.default_rng([seed, index, 2])
  if mix == "all":
    mix = str(rng.choice(MIXES, p=SHARES))
  names = plants or apparatus.KINDS
  shares = np.array([dict(zip(apparatus.KINDS, apparatus.SHARES, strict=True))[n] for n in names])
  paper = apparatus.make_apparatus(str(rng.choice(names, p=shares / shares.sum())), rng)
  habits = recording.draw_habits(paper, rng)
  drawn = _draw(rng, paper, mix, kinds)
  if any(effect.kind == "supply_sag" for effect in drawn):
    habits = dataclasses.replace(habits, logs_supply=True)
  runs = _runs(rng, paper, drawn, (seed, index))
  logs = _make(paper, habits, runs)
  folder.mkdir(parents=True, exist_ok=True)
  (folder / "model.xml").write_text(paper.xml)
  for name, log in logs.items():
    if name.startswith(("train", "held")) or (reference and name.startswith("reference")):
      recording.write(folder / f"{name}.mcap", paper, log)
  return Truth(mix, _answer(paper, mix, drawn, logs))


def _draw(
  rng: np.random.Generator,
  paper: apparatus.Apparatus,
  mix: str,
  kinds: tuple[str, ...] | None,
) -> list[effects.Drawn]:
  """Returns the effects of a set."""
  if mix == "healthy":
    return []
  pool = effects.OUTSIDE if mix == "outside" else effects.LIBRARY
  names = [n for n, m in pool.items() if paper.plant in m.plants and (kinds is None or n in kinds)]
  pairs = [(a, b) for a in names for b in names if effects.may_pair(a, b)]
  if not names or (mix == "pair" and not pairs):
    raise ValueError(f"Found no effect of {kinds} in the mix {mix!r} on {paper.plant!r}.")
  chosen = [str(rng.choice(names))] if mix != "pair" else list(pairs[rng.integers(len(pairs))])
  joints = rng.permutation(len(paper.joints))  # a pair's effects sit on different joints
  return [
    effects.draw(kind, rng, paper, int(joints[place % len(joints)]))
    for place, kind in enumerate(chosen)
  ]


def _runs(
  rng: np.random.Generator,
  paper: apparatus.Apparatus,
  drawn: list[effects.Drawn],
  seed: tuple[int, ...],
) -> list[Run]:
  """Returns all logs of a set, and those that only say what can be seen.

  `paper_*` are of a machine with its data sheet's constants and without latency: wrong constants
  and latencies can be calibrated, and hide nothing for good.
  """
  own = machine.scattered(paper.nominal, rng)
  healthy, other = machine.warmed(own, rng), machine.warmed(own, rng)
  changed, paper_changed = healthy, paper.nominal
  for effect in drawn:
    changed = effects.apply(changed, effect, paper)
    paper_changed = effects.apply(paper_changed, effect, paper)
  train, (held,) = list(motions.TRAIN), list(motions.HELD)
  runs = [Run(name, changed, name, (*seed, 3, i)) for i, name in enumerate(train)]
  runs += [Run(f"reference_{name[6:]}", other, name, (*seed, 4, i)) for i, name in enumerate(train)]
  runs.append(Run(held, changed, held, (*seed, 5)))
  runs.append(Run("twin_healthy", healthy, held, (*seed, 5)))
  for i, name in enumerate((*train, held)):
    runs.append(Run(f"paper_changed_{name}", paper_changed, name, (*seed, 6, i)))
    runs.append(Run(f"paper_healthy_{name}", paper.nominal, name, (*seed, 6, i)))
  return runs


def _make(
  paper: apparatus.Apparatus, habits: recording.Habits, runs: list[Run]
) -> dict[str, recording.Recording]:
  """Simulates all runs at once and returns their recordings by name."""
  step = simulation.STEP
  total = SETTLING + DURATION
  time = np.arange(-SETTLING, DURATION, paper.command_period)
  waves = motions.TRAIN | motions.HELD
  references = np.repeat(paper.center[None, None], len(time), axis=0) * np.ones((1, len(runs), 1))
  moving = time >= -1e-9
  for row, run in enumerate(runs):
    rng = np.random.default_rng(run.seed)
    wave = waves[run.motion]
    references[moving, row] = wave(time[moving], rng, paper.center, paper.amplitude, paper.speed)
  noise = np.random.default_rng((*runs[0].seed, 9))
  sent = np.round((time + SETTLING + noise.uniform(0, 4e-4, len(time))) / step).astype(int)
  batch = machine.stack([run.machine for run in runs])
  latency = np.array([[0.0 if run.name.startswith("paper") else habits.latency] for run in runs])
  batch = batch.change(command_delay=batch.command_delay + latency)
  ideal = dataclasses.replace(habits, skew=0.0)
  commands: np.ndarray | simulation.Host = references
  if paper.mode == "current":
    known = machine.stack([paper.nominal] * len(runs))
    commands = tracking.Tracker(known, references, period=paper.command_period)
  trace = simulation.simulate(
    batch,
    mode=paper.mode,
    start=references[0],
    sent=sent,
    commands=commands,
    steps=round(total / step),
    tick=round(1 / (paper.drive_rate * step)),
  )
  return {
    run.name: recording.record(
      paper,
      run.machine,
      ideal if run.name.startswith("paper") else habits,
      trace=trace,
      row=row,
      sent=sent * step,
      begin=SETTLING,
      duration=DURATION,
      rng=np.random.default_rng((*run.seed, 1)),
    )
    for row, run in enumerate(runs)
  }


def _answer(
  paper: apparatus.Apparatus,
  mix: str,
  drawn: list[effects.Drawn],
  logs: dict[str, recording.Recording],
) -> dict[str, Any]:
  """Returns a set's entry of answers.json."""
  whole = paper.mode != "current"
  ratios = []
  for name in (motions.TRAIN | motions.HELD) if drawn else ():
    floor, seen = (logs[f"paper_{which}_{name}"] for which in ("healthy", "changed"))
    late = declared.lag(paper.xml, floor, whole=whole)
    least = declared.error(paper.xml, floor, whole=whole, late=late)
    ratios.append(np.max(declared.error(paper.xml, seen, whole=whole, late=late) / least))
  held, healthy = (
    float(np.sqrt(np.mean(declared.error(paper.xml, logs[name], whole=whole) ** 2)))
    for name in (next(iter(motions.HELD)), "twin_healthy")
  )
  return {
    "plant": paper.plant,
    "effects": [effects.describe(effect, paper) for effect in drawn],
    "mix": mix,
    "error_ratio": round(float(max(ratios, default=1.0)), 3),
    "below_floor": bool(drawn and max(ratios) < DETECTABLE),
    "held_error": held,
    "healthy_held_error": healthy,
  }
