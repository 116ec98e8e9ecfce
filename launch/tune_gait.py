"""Searches for the scripted gait's parameters in simulation, with CMA-ES.

  python launch/tune_gait.py --generations 40 --out out/gait.json

Every candidate walks on an empty floor in several worlds (servo strength, friction, delays, floor),
so that the gait does not lean on one of them. The best parameters found are the defaults in
`suite.gaits.walk.GaitSettings`.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

from nerf2real.launch import command


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Searches for the gait's parameters in simulation."""

  generations: int = 40
  """Rounds of the search."""
  population: int = 20
  """Candidates in a round."""
  seconds: float = 7.0
  """Length of a walk [s]."""
  worlds: int = 4
  """How many of the worlds are walked in, at most 4."""
  turning: bool = False
  """Whether turning walks count too."""
  start: Path | None = None
  """JSON of an earlier search to go on from."""
  spread: float = 0.3
  """Width of the first round, as a share of the bounds."""
  seed: int = 0
  """Seed of the search."""
  out: Path | None = None
  """Where the best parameters are written after every round."""


def run(arguments: Arguments) -> None:
  """Searches, and prints and writes every round."""
  import numpy as np

  from nerf2real.core.files import check_writable, write_atomically
  from nerf2real.suite.gaits import tuning, walk

  settings = walk.GaitSettings()
  if arguments.start is not None:
    try:
      known = json.loads(arguments.start.read_text())["settings"]
      kept = {name: float(known[name]) for name in tuning.BOUNDS if name in known}
    except (ValueError, KeyError, TypeError) as error:
      raise ValueError(f"{arguments.start} is no result of an earlier search: {error}.") from error
    settings = dataclasses.replace(settings, **kept)
  if arguments.out is not None and arguments.out.parent.exists():
    check_writable(arguments.out)  # a round takes minutes
  names = ("generations", "population", "seconds", "worlds", "turning", "spread", "seed")
  begin = time.monotonic()
  for found in tuning.search(start=settings, **{n: getattr(arguments, n) for n in names}):
    print(
      f"{found.generation:3d} {time.monotonic() - begin:6.0f} s  best {found.best_score:+.3f}  "
      f"round {found.scores.max():+.3f} median {np.median(found.scores):+.3f}  {found.walks[0]}",
      flush=True,
    )
    if arguments.out is not None:
      record = {
        "score": found.best_score,
        "settings": dataclasses.asdict(found.best),
        "walks": found.walks,
        "mean": dataclasses.asdict(found.mean),
      }
      arguments.out.parent.mkdir(parents=True, exist_ok=True)
      write_atomically(arguments.out, json.dumps(record, indent=1))


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, errors=(OSError, ValueError))


if __name__ == "__main__":
  sys.exit(main())
