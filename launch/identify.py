"""Finds the effects that a model lacks, from measured logs.

  python launch/identify.py --model model.xml --logs train_*.mcap --held held_*.mcap --out out/x
  python launch/identify.py --evaluate out/x --held later.mcap

The first writes report.json, report.html, effects.json (for suite.load), model_extended.xml. The
second says whether a later log still fits what was found, writes drift.json and drift.html, and
ends with status 3 where it does not.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf2real.launch import command

DRIFTED = 3
"""Exit status: later logs do not fit the stored result."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Finds the effects that a model lacks, from measured logs."""

  model: Path | None = None
  """Declared MuJoCo model (.xml)."""
  logs: tuple[Path, ...] = ()
  """Logs to identify from (.mcap, .csv, BAM's .json)."""
  held: tuple[Path, ...] = ()
  """Logs on which only errors are reported."""
  reference: tuple[Path, ...] = ()
  """Logs of the same apparatus without the effect, best of the same motions: they tell each joint's
  constants and what differs from them is looked for; they are how bright it is."""
  out: Path | None = None
  """Folder to write; with --evaluate the evaluated one if left out."""
  evaluate: Path | None = None
  """A folder that was written before: print its models' errors on the --held logs, and whether
  these still fit its effects; status 3 where not."""


def run(arguments: Arguments) -> int:
  """Identifies or evaluates, and prints tables.

  Returns:
    DRIFTED where later logs do not fit a result that was evaluated, else 0.

  Raises:
    CommandError: Options are missing.
  """
  if arguments.evaluate is not None:
    if not arguments.held:
      raise command.CommandError(
        "Found no --held log, expected at least one to evaluate on.", status=command.WRONG_ARGUMENTS
      )
    _print_errors(arguments.evaluate, arguments.held)
    return _check_drift(arguments.evaluate, arguments.held, arguments.out)
  if arguments.model is None or not arguments.logs or arguments.out is None:
    raise command.CommandError(
      "Found no --model, --logs or --out, expected all three (see --help).",
      status=command.WRONG_ARGUMENTS,
    )
  from nerf2real import sysid
  from nerf2real.core.progress import progress_bar

  with progress_bar("identify") as progress:
    content = sysid.identify(
      arguments.model,
      list(arguments.logs),
      held=arguments.held,
      reference=arguments.reference,
      out=arguments.out,
      progress=progress,
    )
  _print_content(content, arguments.out)
  return 0


def _print_content(content: dict[str, Any], out: Path) -> None:
  import rich
  from rich.markup import escape
  from rich.table import Table

  from nerf2real.sysid.model import simulation as evaluation
  from nerf2real.sysid.report.alike import place, together
  from nerf2real.sysid.report.summary import not_told_apart

  rich.print(f"[bold]{escape(content['verdict'])}[/bold] in {content['seconds']:.0f} s")
  table = Table("effect", "where", "parameter", "value", "95 %", "unit")
  for effect in together(content["effects"]):
    for name, value in effect["parameters"].items():
      interval = "" if value["low"] is None else f"{value['low']:.4g} .. {value['high']:.4g}"
      table.add_row(
        effect["kind"],
        escape(place(effect)),
        name,
        _number(value["value"]),
        interval,
        value["unit"],
      )
  if table.rows:
    rich.print(table)
    if rivals := not_told_apart(content["alternatives"]):
      print(rivals)
  for note in content["notes"]:
    print(f"note: {note}")
  for name in ("train", "held"):
    error = content["error"][name]
    if error:
      worse = " (worse: do not use it)" if evaluation.is_worse(error) else ""
      print(f"{name}: {error['before']:.3g} -> {error['after']:.3g} rad (or m) RMSE{worse}")
  print(f"floor: {content['error']['floor']:.3g}; report: {out / 'report.html'}")


def _number(value: float | None) -> str:
  return "-" if value is None else f"{value:.4g}"


def _print_errors(folder: Path, held: Sequence[Path]) -> None:
  import rich
  from rich.markup import escape
  from rich.table import Table

  from nerf2real import sysid

  table = Table("log", "declared", "extended", "lower by")
  for row in sysid.evaluate(folder, held):
    ratio = row["before"] / max(row["after"], 1e-12)
    errors = f"{row['before']:.3g}", f"{row['after']:.3g}"
    table.add_row(escape(row["log"]), *errors, f"{ratio:.2f} times")
  rich.print(table)


def _check_drift(folder: Path, held: Sequence[Path], out: Path | None) -> int:
  """Prints whether later logs fit a stored result; returns the exit status."""
  import rich
  from rich.markup import escape

  from nerf2real import sysid
  from nerf2real.sysid.drift import page

  found = sysid.check_drift(folder, held, out=out)
  rich.print(f"[bold]{escape(page.sentence(found))}[/bold]")
  for kind in found.not_judged:
    print(f"not compared: {kind}")
  print(f"page: {(out or folder) / 'drift.html'}")
  return 0 if found.holds else DRIFTED


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=command.ONE_THREAD)


if __name__ == "__main__":
  sys.exit(main())
