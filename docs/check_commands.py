"""Runs the commands of all READMEs and prints how each ended and how long it took.

  python docs/check_commands.py            # all, in the order of the READMEs
  python docs/check_commands.py --list     # runs none
  python docs/check_commands.py --only identify

Commands are the code spans and lines that begin with `.venv/bin/python`, `python`, `nerf2real` or
`make`. docs/commands.toml says which run in a reduced form, which serve until Ctrl-C, and which are
left out and why; every other one runs as it is printed.
"""

import argparse
import os
import pathlib
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from typing import Any, NamedTuple

ROOT = pathlib.Path(__file__).resolve().parents[1]
TABLE = ROOT / "docs" / "commands.toml"
_READMES = ("README.md", "*/README.md", "*/*/README.md")
_BEGINS = r"(?:\.venv/bin/python|python|nerf2real|make)"
_SPAN = re.compile(rf"`({_BEGINS} [^`\n]+)`")
_LINE = re.compile(rf"^ *({_BEGINS} (?:[^`\n]*\\\n)*[^`\n]+?)(?: +#.*)?$", re.MULTILINE)
_TIMEOUT = 1800.0  # s of a command
_LINKS = "nerf2real"  # holds links to the packages
OK, FAILED, SKIPPED = "ok", "FAILED", "left out"


class Ended(NamedTuple):
  """How a command ended."""

  state: str
  seconds: float
  detail: str


def commands(root: pathlib.Path = ROOT) -> Iterator[tuple[pathlib.Path, str]]:
  """Yields the READMEs' commands, each once."""
  seen = set()
  for pattern in _READMES:
    for path in sorted(root.glob(pattern)):
      inner = path.relative_to(root).parts[:-1]
      if _LINKS in inner or any(part.startswith(".") for part in inner):
        continue
      text = path.read_text()
      found = [(m.start(), m[1]) for m in (*_SPAN.finditer(text), *_LINE.finditer(text))]
      for _, lines in sorted(found):
        command = " ".join(lines.replace("\\\n", " ").split())
        if command not in seen:
          seen.add(command)
          yield path, command


def table() -> dict[str, dict[str, Any]]:
  """Returns what is said of commands in docs/commands.toml, by command."""
  return {entry["command"]: entry for entry in tomllib.loads(TABLE.read_text())["command"]}


def run(command: str, entry: dict[str, Any]) -> Ended:
  """Runs a command as its entry says."""
  if "skip" in entry:
    return Ended(SKIPPED, 0.0, entry["skip"])
  text = entry.get("run", command)
  python = shlex.quote(sys.executable)
  text = re.sub(r"^(\.venv/bin/python|python)\b", python, text)
  text = re.sub(r"^nerf2real\b", f"{python} -m nerf2real.launch.console", text)
  begin = time.monotonic()
  process = subprocess.Popen(
    text,
    shell=True,
    executable="/bin/bash",
    cwd=ROOT,
    stdin=subprocess.DEVNULL,
    stdout=subprocess.PIPE,
    stderr=subprocess.STDOUT,
    text=True,
    start_new_session=True,
  )
  assert process.stdout is not None
  lines: list[str] = []
  if "serves" in entry:  # until it says so, then Ctrl-C
    for line in process.stdout:
      lines.append(line)
      if entry["serves"] in line:
        break
    ready = time.monotonic() - begin
    os.killpg(process.pid, signal.SIGINT)
    rest, _ = process.communicate(timeout=60)
    good = process.returncode in (0, 128 + signal.SIGINT) and "Traceback" not in rest
    last = (lines or [rest])[-1].strip()
    return Ended(OK if good else FAILED, ready, last if good else rest[-300:])
  try:
    output, _ = process.communicate(timeout=_TIMEOUT)
  except subprocess.TimeoutExpired:
    process.kill()
    return Ended(FAILED, _TIMEOUT, f"not over after {_TIMEOUT:g} s")
  seconds = time.monotonic() - begin
  good = process.returncode == entry.get("status", 0) and "Traceback" not in output
  last = (output.strip().splitlines() or [""])[-1]
  return Ended(OK if good else FAILED, seconds, last if good else output[-600:])


def main() -> int:
  """Runs the commands; returns 1 if one failed."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--list", action="store_true", help="prints the commands, runs none")
  parser.add_argument("--only", default="", help="runs commands that hold this text")
  arguments = parser.parse_args()
  known, failed, count = table(), 0, 0
  for path, command in commands():
    if arguments.only not in command:
      continue
    entry = known.get(command, {})
    if arguments.list:
      print(f"{path.relative_to(ROOT)}: {command}" + (f"  -> {entry}" if entry else ""))
      continue
    ended = run(command, entry)
    count, failed = count + 1, failed + (ended.state == FAILED)
    print(f"{ended.state:8s} {ended.seconds:6.1f} s  {command}: {ended.detail}", flush=True)
  if not arguments.list:
    print(f"{count} commands, {failed} failed")
  return 1 if failed else 0


if __name__ == "__main__":
  sys.exit(main())
