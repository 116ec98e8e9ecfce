"""Makes blind sets: `python benchmarks/make_blind_sets.py --out out/blind --seed 0 --count 20`.

Each set is a folder with the declared `model.xml`, three logs to identify from and two held out;
`answers.json` beside them holds what each machine has that its model lacks. The plant is
`blind_sets`, which shares no code with the analyser. The same seed gives the same logs.
"""

import contextlib
import dataclasses
import json
import multiprocessing
import pathlib
import time
from collections.abc import Iterable
from typing import Literal

from benchmarks import harness
from benchmarks.blind_sets import sets


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
  mix: Literal["single", "pair", "outside", "healthy", "all"] = "all"
  """What the machines have: one effect, two, one that no library has, none, or all of these."""
  plants: tuple[str, ...] = ()
  """Kinds of apparatus, of pendulum, arm, op3; empty: all."""
  kinds: tuple[str, ...] = ()
  """Kinds of effect to draw from; empty: all."""
  reference: bool = False
  """Also write reference_*.mcap: the same machine without the effects."""
  processes: int = 1
  """Sets made at the same time."""


def main(settings: Settings) -> None:
  """Writes sets that are not there yet and answers.json."""
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
        f"held-out error {1e3 * answer['held_error']:.1f} mrad, "
        f"{answer['error_ratio']:.1f} times the floor; {seconds:.1f} s",
        flush=True,
      )


def _name(settings: Settings, index: int) -> str:
  return f"{settings.seed}_{index:03d}"


def _make(job: tuple[Settings, int]) -> tuple[str, dict, float]:
  settings, index = job
  start = time.perf_counter()
  truth = sets.make_set(
    settings.out / _name(settings, index),
    seed=settings.seed,
    index=index,
    mix=settings.mix,
    plants=settings.plants or None,
    kinds=settings.kinds or None,
    reference=settings.reference,
  )
  return _name(settings, index), truth.answer, time.perf_counter() - start


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
