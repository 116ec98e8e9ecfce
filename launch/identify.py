"""Finds the effect that a model lacks, from measured logs.

  python launch/identify.py --model model.xml --logs train_*.mcap --held held_*.mcap --out out/x
  python launch/identify.py --evaluate out/x --held other.mcap

Writes report.json, report.html, effects.json (for suite.load), model_extended.xml.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import rich
import tyro
from rich.table import Table

from nerf2real import sysid


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Finds the effect that a model lacks, from measured logs."""

  model: Path | None = None
  """Declared MuJoCo model (.xml)."""
  logs: tuple[Path, ...] = ()
  """Logs to identify from (.mcap)."""
  held: tuple[Path, ...] = ()
  """Logs on which only errors are reported."""
  reference: tuple[Path, ...] = ()
  """Logs of the same apparatus without the effect: they calibrate the declared constants first, and
  say how bright the place is."""
  out: Path | None = None
  """Folder to write."""
  evaluate: Path | None = None
  """A folder that was written before: print its models' errors on the --held logs."""


def main() -> int:
  """Runs the command line; a wrong input is one line on stderr."""
  arguments = tyro.cli(Arguments, description=__doc__)
  try:
    if arguments.evaluate is not None:
      return _evaluate(arguments)
    return _identify(arguments)
  except (OSError, ValueError) as error:
    print(f"error: {error}", file=sys.stderr)
    return 2


def _identify(arguments: Arguments) -> int:
  if arguments.model is None or not arguments.logs or arguments.out is None:
    raise ValueError("Found no --model, --logs or --out, expected all three (see --help).")
  content = sysid.identify(
    arguments.model,
    list(arguments.logs),
    held=arguments.held,
    reference=arguments.reference,
    out=arguments.out,
  )
  rich.print(f"[bold]{content['verdict']}[/bold] in {content['seconds']:.0f} s")
  table = Table("effect", "where", "parameter", "value", "95 %", "unit")
  for effect in content["effects"]:
    for name, value in effect["parameters"].items():
      if isinstance(value["value"], list):
        continue
      interval = "" if value["low"] is None else f"{value['low']:.4g} .. {value['high']:.4g}"
      table.add_row(
        effect["kind"], _place(effect), name, _number(value["value"]), interval, value["unit"]
      )
  from nerf2real.sysid.model import simulation as evaluation

  if table.rows:
    rich.print(table)
  for note in content["notes"]:
    rich.print(f"note: {note}")
  for name in ("train", "held"):
    error = content["error"][name]
    if error:
      worse = " (worse: do not use it)" if evaluation.is_worse(error) else ""
      rich.print(f"{name}: {error['before']:.5f} -> {error['after']:.5f} rad (or m) RMSE{worse}")
  rich.print(f"floor: {content['error']['floor']:.5f}; report: {arguments.out / 'report.html'}")
  return 0


def _place(effect: dict[str, Any]) -> str:
  return effect["joint"] or effect.get("geom") or effect.get("sensor") or "all"


def _number(value: float | None) -> str:
  return "-" if value is None else f"{value:.4g}"


def _evaluate(arguments: Arguments) -> int:
  if not arguments.held:
    raise ValueError("Found no --held log, expected at least one to evaluate on.")
  assert arguments.evaluate is not None
  table = Table("log", "declared", "extended", "lower by")
  for row in sysid.evaluate(arguments.evaluate, arguments.held):
    ratio = row["before"] / max(row["after"], 1e-12)
    table.add_row(row["log"], f"{row['before']:.6f}", f"{row['after']:.6f}", f"{ratio:.2f} times")
  rich.print(table)
  return 0


if __name__ == "__main__":
  sys.exit(main())
