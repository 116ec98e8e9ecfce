"""Makes blind sets: `python benchmarks/make_blind_sets.py --out out/blind --seed 0 --count 20`.

Each set is a folder with the declared `model.xml`, three logs to identify from and two held out;
`answers.json` beside them holds what each machine has that its model lacks. Five generators that
share no equations with each other or with the analyser: `blind_sets`; `independent_sets`, which has
one log held out and always three of the healthy machine; `servo_bench`, one servo with an arm,
`drive_axes`, axes under cascaded control, and `hobby_joints`, joints of hobby servos, which have
those three, too. The same seed gives the same logs.
"""

import contextlib
import dataclasses
import json
import multiprocessing
import pathlib
import time
from collections.abc import Callable, Iterable
from typing import Any, Literal

from benchmarks import harness
from benchmarks.blind_sets import sets
from benchmarks.drive_axes import sets as drive_sets
from benchmarks.hobby_joints import sets as hobby_sets
from benchmarks.independent_sets import sets as independent_sets
from benchmarks.servo_bench import sets as servo_sets

GENERATORS: dict[str, Callable[..., Any]] = {
  "blind_sets": sets.make_set,
  "independent_sets": independent_sets.make_set,
  "servo_bench": servo_sets.make_set,
  "drive_axes": drive_sets.make_set,
  "hobby_joints": hobby_sets.make_set,
}

WITH_REFERENCES = ("independent_sets", "servo_bench", "drive_axes", "hobby_joints")
"""Generators whose sets always have logs of the healthy machine."""

WITH_DAYS = ("servo_bench", "drive_axes", "hobby_joints")
"""Generators whose references are of the same day or of another."""

HALF_HEALTHY = (
  *("healthy", "single", "healthy", "pair", "healthy"),
  *("single", "healthy", "outside", "healthy", "single"),
)
"""Of ten sets in a row, in the mix `half`: a run that is cut short is a fair sample."""


@dataclasses.dataclass(frozen=True)
class Settings:
  """What to make."""

  out: pathlib.Path = pathlib.Path("out/blind")
  """Folder for the sets and answers.json."""
  seed: int = 0
  """Of the whole collection."""
  count: int = 20
  """Number of sets."""
  first: int = 0
  """Index of the first set; a set depends on seed and index alone."""
  generator: Literal[
    "blind_sets", "independent_sets", "servo_bench", "drive_axes", "hobby_joints"
  ] = "blind_sets"
  """Which package makes them."""
  mix: Literal["single", "pair", "outside", "healthy", "all", "half"] = "all"
  """What the machines have: one effect, two, one that no library has, none, or all of these, drawn
  (all) or in turn with every second machine healthy (half)."""
  plants: tuple[str, ...] = ()
  """Kinds of apparatus: of pendulum, arm, op3; of slider, arm, wheel; of hanging, bent, level,
  turntable; of lift, swing, planar; of single, head, leg, finger; empty: all."""
  kinds: tuple[str, ...] = ()
  """Kinds of effect to draw from; empty: all."""
  reference: bool = False
  """Also write reference_*.mcap: the same machine without the effects; all but `blind_sets`
  always do."""
  same_day: bool = False
  """References of the same day, so that only noise is another (`servo_bench`, `drive_axes`,
  `hobby_joints`; of `independent_sets` they always are)."""
  processes: int = 1
  """Sets made at the same time."""


def main(settings: Settings) -> None:
  """Writes sets that are not there yet and answers.json."""
  if settings.same_day and settings.generator not in WITH_DAYS:
    raise ValueError(f"--same-day is of {WITH_DAYS}, found --generator {settings.generator}.")
  settings.out.mkdir(parents=True, exist_ok=True)
  path = settings.out / "answers.json"
  answers = json.loads(path.read_text()) if path.is_file() else {}
  indices = range(settings.first, settings.first + settings.count)
  jobs = [(settings, index) for index in indices if _name(settings, index) not in answers]
  with contextlib.ExitStack() as stack:
    made: Iterable[tuple[str, dict, float]] = map(_make, jobs)
    if settings.processes > 1:
      pool = multiprocessing.get_context("spawn").Pool(settings.processes)
      made = stack.enter_context(pool).imap(_make, jobs)
    for name, answer, seconds in made:
      answers[name] = answer
      path.write_text(json.dumps(answers, indent=1))
      kinds = ", ".join(f"{e['kind']}@{e['joint']}" for e in answer["effects"]) or "none"
      print(
        f"{name}: {answer['plant']}, {kinds}; "
        f"held-out error {1e3 * answer['held_error']:.1f} mrad or mm, "
        f"{answer['error_ratio']:.1f} times the floor; {seconds:.1f} s",
        flush=True,
      )


def _name(settings: Settings, index: int) -> str:
  return f"{settings.seed}_{index:03d}"


def mix_of(mix: str, index: int) -> str:
  """Returns what the set of an index is drawn from, for the generators."""
  return HALF_HEALTHY[index % len(HALF_HEALTHY)] if mix == "half" else mix


def _make(job: tuple[Settings, int]) -> tuple[str, dict, float]:
  settings, index = job
  start = time.perf_counter()
  days = {"same_day": True} if settings.same_day else {}
  truth = GENERATORS[settings.generator](
    settings.out / _name(settings, index),
    seed=settings.seed,
    index=index,
    mix=mix_of(settings.mix, index),
    plants=settings.plants or None,
    kinds=settings.kinds or None,
    reference=settings.reference or settings.generator in WITH_REFERENCES,
    **days,
  )
  return _name(settings, index), truth.answer, time.perf_counter() - start


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
