"""Runs one benchmark command in two checkouts in turn; prints medians, p95 and ratios.

  python benchmarks/simulation/env.py --other ../before --rounds 4
  python benchmarks/compare.py --other ../before --command "benchmarks/learning/link.py --out {out}"

Each run is a process of its own in its checkout, with PYTHONPATH set to it, and runs that
checkout's own script. Compared is the time of the whole command and every number of the JSON that
it writes to `{out}`, matched by name: the words of its path in any order, so that a file's layout
may have changed.
"""

import dataclasses
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro

from benchmarks.ledger.records import ROOT
from benchmarks.turns import percentile
from nerf2real.core.markdown import table

# Words of the path to a number that do not describe it.
_CONTAINERS = {"figures", "variants", "results", "rows", "sizes", "runs", "here"}
_MOST_ALONE = 6  # names that only one checkout has and that are listed
# Words that older files had for the same.
_SYNONYMS = {"second": "s", "cpu": "processor", "max": "longest"}
# Values that name the dict they stand in.
_NAMES = ("name", "picture", "size")
# Numbers that are no measurements.
_IGNORED = {"settings", "versions", "load", "load_average", "cores", "cores_used", "seed", "date"}


@dataclasses.dataclass(frozen=True)
class Comparison:
  """Values of one figure, here and in the other checkout, turn by turn."""

  name: str
  here: list[float]
  other: list[float]

  @property
  def ratio(self) -> float:
    """Median here over the median there."""
    there = percentile(self.other, 50)
    return percentile(self.here, 50) / there if there else float("nan")


def numbers(content: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], float]]:
  """Yields every number of a JSON document with the words of its path."""
  if isinstance(content, bool):
    return
  if isinstance(content, int | float):
    yield path, float(content)
  elif isinstance(content, dict):
    own = next((str(content[key]) for key in _NAMES if isinstance(content.get(key), str)), None)
    for key, value in content.items():
      if key not in _IGNORED:
        yield from numbers(value, (*path, *([own] if own else []), str(key)))
  elif isinstance(content, list):
    named = all(isinstance(item, dict) for item in content)
    for index, item in enumerate(content):
      yield from numbers(item, path if named else (*path, str(index)))


def key(path: tuple[str, ...]) -> tuple[str, ...]:
  """Returns what two layouts of a file have in common: the words of a path, sorted."""
  words = re.findall(r"[a-z0-9]+", " ".join(path).lower())
  return tuple(sorted({_SYNONYMS.get(word, word) for word in words} - _CONTAINERS))


def moved(checkout: Path, words: list[str]) -> list[str]:
  """Returns a command with its script where a checkout has it: folders change between commits."""
  script, *rest = words
  if (checkout / script).is_file():
    return words
  places = sorted((checkout / "benchmarks").rglob(Path(script).name))
  return [str(places[0].relative_to(checkout)), *rest] if len(places) == 1 else words


def last_error(done: subprocess.CompletedProcess[str]) -> str:
  """Returns the line of a failed program's output that holds the reason."""
  lines = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
  errors = [line for line in lines if re.match(r"(\w+\.)*\w*(Error|Exception|error)\b", line)]
  return (errors or lines)[-1]


def run_once(checkout: Path, command: list[str]) -> dict[tuple[str, ...], tuple[str, float]]:
  """Runs a command in a checkout; returns its numbers by key, each with its name.

  Raises:
    RuntimeError: The command fails.
  """
  with tempfile.TemporaryDirectory() as folder:
    out = Path(folder) / "out.json"
    words = [word.replace("{out}", str(out)) for word in command]
    begin = time.perf_counter()
    done = subprocess.run(
      [sys.executable, *moved(checkout, words)],
      cwd=checkout,
      env=os.environ | {"PYTHONPATH": str(checkout)},
      capture_output=True,
      text=True,
    )
    seconds = time.perf_counter() - begin
    if done.returncode:
      raise RuntimeError(f"{shlex.join(words)} failed in {checkout}: {last_error(done)}")
    found: dict[tuple[str, ...], tuple[str, float]] = {
      ("command", "s"): ("the whole command, s", seconds)
    }
    paths = [out] if out.is_file() else sorted(out.glob("*.json"))  # render.py wrote a folder
    for path in paths:
      for words_of, value in numbers(json.loads(path.read_text())):
        found[key(words_of)] = (", ".join(words_of).replace("_", " "), value)
  return found


def compare(
  other: Path, command: list[str], *, turns: int, here: Path = ROOT
) -> tuple[list[Comparison], list[str]]:
  """Runs a command in two checkouts in turn.

  Returns:
    The comparisons, and the names that only one of the two has.
  """
  runs: dict[Path, list[dict]] = {here: [], other: []}
  for turn in range(turns):
    for checkout in (here, other) if turn % 2 == 0 else (other, here):
      runs[checkout].append(run_once(checkout, command))
  both, alone = [], []
  everything = {k: v[0] for found in (*runs[other], *runs[here]) for k, v in found.items()}
  for name, words in everything.items():
    columns = [[f[name][1] for f in runs[side] if name in f] for side in (here, other)]
    if all(columns):
      both.append(Comparison(words, *columns))
    else:
      alone.append(words)
  return both, alone


def markdown(rows: list[Comparison]) -> str:
  """Returns the table."""

  def cell(values: list[float]) -> str:
    return f"{percentile(values, 50):.4g} ({percentile(values, 95):.4g})"

  return table(
    ("figure", "here: median (p95)", "other: median (p95)", "here / other"),
    [(row.name, cell(row.here), cell(row.other), f"{row.ratio:.3f}") for row in rows],
  )


def own_command(arguments: list[str], other: Path) -> str:
  """Returns a script's command line without --other and --turns, and with --out {out}.

  Args:
    arguments: sys.argv of the script.
    other: The other checkout, whose script may call the option --output.
  """
  name = str(Path(arguments[0]).resolve().relative_to(ROOT))
  line = " ".join(shlex.quote(word) for word in arguments[1:])
  line = re.sub(r"--(other|turns)(=| +)\S+", "", line)
  script = other / moved(other, [name])[0]
  old = script.is_file() and re.search(r"^  output: ", script.read_text(), re.M)
  return f"{name} {line.strip()} {'--output' if old else '--out'} {{out}}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
  """What to compare."""

  other: Path
  """Root of the other checkout."""
  command: str
  """Script and options from the root, {out} in the place of its file of figures."""
  turns: int = 3
  """Runs in each checkout."""


def main(settings: Settings) -> int:
  """Compares and prints; returns the exit status."""
  if not settings.other.is_dir():
    print(f"error: found no folder {settings.other}; --other is the root of another checkout.")
    return 1
  command = shlex.split(settings.command.removeprefix("python "))
  try:
    rows, alone = compare(settings.other.resolve(), command, turns=settings.turns)
  except RuntimeError as error:
    print(f"error: {error}")
    return 1
  print(f"`{shlex.join(command)}`, {settings.turns} turns; here {ROOT}, other {settings.other}\n")
  print(markdown(rows))
  if alone:
    more = f" and {len(alone) - _MOST_ALONE} more" if len(alone) > _MOST_ALONE else ""
    print(f"\nonly in one of the two: {'; '.join(alone[:_MOST_ALONE])}{more}")
  return 0


if __name__ == "__main__":
  sys.exit(main(tyro.cli(Settings, description=__doc__)))
