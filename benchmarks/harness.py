"""Measures calls in turns on a machine that it names, prints the figures and records them.

Every script of this folder is a dataclass of settings that extends `Options`, a `main`, and

  if __name__ == "__main__":
    harness.run(main, Settings, __doc__)

which adds to its own options: `--write` keeps the figures as records of the ledger, `--out FILE`
writes them as JSON (or as a Markdown table if it ends in .md), and `--other PATH [--turns N]` runs
the same command here and in another checkout in turn (`benchmarks/compare.py`).

Nothing here imports numpy, so that `one_thread` comes before its threads are made.
"""

import dataclasses
import datetime
import importlib.metadata
import itertools
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from benchmarks import compare
from benchmarks.ledger import records as ledger
from benchmarks.ledger.records import ROOT, Rate, Value
from benchmarks.turns import Times, interleave, percentile
from nerf2real.core import markdown

__all__ = [  # what scripts use of this module, and of those that it is made of
  "Machine",
  "Options",
  "Rate",
  "Times",
  "Value",
  "finish",
  "interleave",
  "machine",
  "one_core",
  "one_thread",
  "percentile",
  "provenance",
  "run",
  "table",
]

_PACKAGES = ("numpy", "mujoco", "dm-control", "jax", "warp-lang", "numba", "eclipse-zenoh")
T = TypeVar("T")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
  """What every benchmark does with its figures."""

  write: bool = False
  """Keep the figures as records in benchmarks/results/records/."""
  out: Annotated[Path | None, tyro.conf.arg(aliases=("--output",))] = None
  """Also write the figures here: JSON, or a Markdown table if it ends in .md."""
  other: Path | None = None
  """Root of another checkout: run this command here and there in turn, and compare."""
  turns: int = 3
  """With --other: runs in each checkout."""


def run(main: Callable[[T], Any], settings: type[T], description: str | None) -> None:
  """Runs a script; with --other, the comparison of two checkouts instead.

  A ValueError or OSError ends it in one line, as in commands of `launch`.

  Args:
    main: Takes the settings; what it returns is the exit status.
    settings: Their class.
    description: Of the script.
  """
  chosen = tyro.cli(settings, description=description)
  other = getattr(chosen, "other", None)
  if other is not None:
    command = compare.own_command(sys.argv, other)
    sys.exit(compare.main(compare.Settings(other=other, command=command, turns=chosen.turns)))  # type: ignore[attr-defined]
  try:
    sys.exit(main(chosen))
  except (ValueError, OSError) as error:
    sys.exit(f"error: {error}")


def one_thread() -> None:
  """Keeps BLAS on one thread and MuJoCo's pictures off the screen; call it before numpy comes."""
  for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
  os.environ.setdefault("MUJOCO_GL", "egl")


def one_core(core: int | None = None) -> None:
  """Keeps this process on one core, by default the first that it may use."""
  if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0)) if core is None else core})


@dataclasses.dataclass(frozen=True)
class Machine:
  """What the figures depend on."""

  cpu: str
  cores: int
  memory_gb: float
  gpu: str = ""
  gpu_memory_gb: float = 0.0

  def __str__(self) -> str:
    """Returns one line."""
    gpu = f", {self.gpu} ({self.gpu_memory_gb:.0f} GB)" if self.gpu else ", no GPU"
    return f"{self.cpu}, {self.cores} cores, {self.memory_gb:.0f} GB{gpu}"


def machine() -> Machine:
  """Returns the machine that this runs on."""
  information = Path("/proc/cpuinfo")
  lines = information.read_text().splitlines() if information.exists() else []
  names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
  pages = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
  gpu, _, memory = _output("nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader")[
    :200
  ].partition(",")
  return Machine(
    names[0] if names else platform.processor() or platform.machine(),
    os.cpu_count() or 1,
    round(pages / 1e9, 1),
    gpu.strip(),
    round(float(memory.split()[0]) / 1024, 1) if memory.strip() else 0.0,
  )


def _output(*command: str) -> str:
  """Returns the first line that a program prints; empty if it cannot run."""
  try:
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
  except (OSError, subprocess.SubprocessError):
    return ""
  return next(iter(done.stdout.splitlines()), "")


def command_line() -> str:
  """Returns this command as it is typed in the root, without --write: no record names a machine's
  folders, so that of a path elsewhere its last two parts stay."""
  script = Path(sys.argv[0]).resolve()
  name = script.relative_to(ROOT) if script.is_relative_to(ROOT) else script.name
  words = [_portable(word) for word in sys.argv[1:] if word != "--write"]
  return shlex.join(["python", str(name), *words])


def _portable(word: str) -> str:
  option, equals, value = word.rpartition("=")
  path = Path(value)
  if not path.is_absolute():
    return word
  path = path.relative_to(ROOT) if path.is_relative_to(ROOT) else Path(*path.parts[1:][-2:])
  return f"{option}{equals}{path}"


def versions() -> dict[str, str]:
  """Returns the versions of Python and of the packages on which speed depends."""
  found = {"python": platform.python_version()}
  for name in _PACKAGES:
    try:
      found[name] = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
      continue
  return found


def provenance(seed: int | str | None = None) -> dict[str, Any]:
  """Returns a record's fields on where its figures come from."""
  git = ("git", "-C", str(ROOT))
  return {
    "command": command_line(),
    "commit": _output(*git, "rev-parse", "--short", "HEAD") or ledger.UNKNOWN,
    "dirty": bool(_output(*git, "status", "--porcelain")),
    "machine": str(machine()),
    "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    "seed": seed,
    "versions": versions(),
    "load": round(os.getloadavg()[0], 1),
  }


def table(figures: Mapping[str, Mapping[str, Value]], *, first: str = "") -> str:
  """Returns Markdown tables, one for rows of the same values: a row a name, a column a value."""
  tables = []
  for columns, rows in itertools.groupby(figures.items(), lambda item: list(item[1])):
    heads = [first, *(column.replace("_", " ") for column in columns)]
    cells = [(name, *map(_cell, values.values())) for name, values in rows]
    tables.append(markdown.table(heads, cells))
  return "\n\n".join(tables)


def _cell(value: Value) -> str:
  if isinstance(value, Rate):
    return f"{value.count} of {value.of}"
  return f"{value:.4g}" if isinstance(value, float) else str(value)


def finish(
  topic: str,
  figures: Mapping[str, Mapping[str, Value]],
  settings: Options | None = None,
  *,
  seed: int | str | None = None,
  details: Any = None,
  words: str = "",
  within: str = "",
) -> None:
  """Prints figures, and writes them as the options require.

  Args:
    topic: Name of the file of records.
    figures: Values by name of the record; a value's name ends in its unit.
    settings: The script's settings; None: prints only.
    seed: Of what was random.
    details: More to keep in the JSON file.
    words: Markdown below the table.
    within: Folder of `records/` for a topic that has no file yet.
  """
  origin = provenance(seed)
  text = f"{origin['machine']}; commit {origin['commit']}, load {origin['load']}\n\n"
  text += table(figures, first=topic) + "\n" + (f"\n{words}\n" if words else "")
  print(text, end="")
  if settings is None:
    return
  if settings.out is not None:
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    if settings.out.suffix == ".md":
      settings.out.write_text(f"`{origin['command']}`, {origin['date']}, {text}")
    else:
      content = origin | {"settings": dataclasses.asdict(settings), "figures": figures}
      content |= {"details": details} if details is not None else {}
      settings.out.write_text(json.dumps(content, indent=1, default=_plain) + "\n")
  if settings.write:
    print(f"wrote {ledger.update(topic, figures, origin, within=within)}")


def _plain(value: Any) -> Any:
  return value.to_dict() if isinstance(value, Rate) else str(value)
