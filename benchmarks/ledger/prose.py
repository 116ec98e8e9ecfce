"""Finds figures in the prose of a README that have no record.

A figure is a number with a unit, or "N of M". It is recorded if it stands in a block that
`benchmarks/tables.py` generates, or in a paragraph with `<!-- record: id, id -->` and equals a
value of one of these records at the precision that it is written with. Settings, sizes and the
paper's values are listed in `benchmarks/ledger/settings.toml`, each with what it is.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.ledger.records import Rate, Record

ALLOWED = Path(__file__).with_name("settings.toml")

_UNIT = (
  r"%|dB|degrees?|deg|mrad|rad/s|rad|mm|cm|km|m/s\^2|m/s|m|ms|us|s|seconds?|minutes?|hours?|"
  r"kHz|MHz|Hz|Mbps|MB/s|KB|MB|GB|MiB|GiB|px|pixels?|steps/s|updates/s|rays/s|samples/s|messages/s|"
  r"N m|N|V|W|g|kg|times|nats|steps|updates"
)
_NUMBER = r"-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?"
_BEFORE = r"(?<![\w.,/^*=<>-])"
_FIGURES = re.compile(
  rf"{_BEFORE}({_NUMBER}(?:(?:\s*(?:/|,|;|\+-|±)\s*|\s+(?:to|and|or)\s+){_NUMBER})*)"
  rf"\s*({_UNIT})(?![\w/^-])"
)
_COUNTS = re.compile(rf"{_BEFORE}(\d[\d,]*) of (\d[\d,]*)(?![\d.]*\w)")
_RECORD = re.compile(r"<!-- record: ([^>]*?) -->")
BLOCK = re.compile(r"<!-- figures: (\S+) -->\n(.*?)<!-- /figures -->", re.S)


def paragraphs(text: str) -> Iterator[tuple[str, list[str]]]:
  """Yields the prose of a README: paragraphs and rows of tables, with the records they name.

  Generated blocks, code and the targets of links are left out.
  """
  text = BLOCK.sub("\n", text)
  text = re.sub(r"^```.*?^```", "\n", text, flags=re.S | re.M)
  text = re.sub(r"`[^`\n]*`", " ` ", text)
  text = re.sub(r"\]\([^)\s]*\)", "]", text)
  for part in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]\s|\||\d+\.\s))", text):
    ids = [name for found in _RECORD.findall(part) for name in re.split(r",\s*", found.strip())]
    words = re.sub(r"<!--.*?-->", "", part, flags=re.S)
    words = re.sub(r"^\s*\d+\.\s", "", words)  # a list's own numbers
    if words.strip():
      yield " ".join(words.split()), ids


def figures(words: str) -> Iterator[str]:
  """Yields the figures of a paragraph: "2.3 degrees", "10 of 11"."""
  for match in _FIGURES.finditer(words):
    for number in re.findall(_NUMBER, match[1]):
      yield f"{number.rstrip(',')} {match[2]}"
  for match in _COUNTS.finditer(words):
    yield f"{match[1]} of {match[2]}"


def matches(figure: str, record: Record) -> bool:
  """Returns whether a figure equals a value of a record at the precision that it has."""
  number, unit = figure.split(" ", 1)
  wanted = number.replace(",", "")
  if unit.startswith("of "):
    counts = (int(wanted), int(unit[3:].replace(",", "")))
    rates = [value for value in record.values.values() if isinstance(value, Rate)]
    return any((rate.count, rate.of) == counts for rate in rates)
  digits = len(wanted.partition(".")[2])
  for name, value in record.values.items():
    if isinstance(value, str):
      continue
    known = "%" if isinstance(value, Rate) else record.unit.get(name, "")
    exact = 100 * value.count / value.of if isinstance(value, Rate) else float(value)
    if _same_unit(unit, known) and f"{exact:.{digits}f}" == wanted:
      return True
  return False


def _same_unit(written: str, known: str) -> bool:
  short = {"degree": "degrees", "deg": "degrees", "seconds": "s", "minute": "minutes"}
  return short.get(written, written) == short.get(known, known)


def read_allowed(path: Path = ALLOWED) -> dict[str, dict[str, str]]:
  """Returns the numbers that are no figures, by README ("*": all of them), and what they are."""
  tables = tomllib.loads(path.read_text())
  return {
    name: {number: what for numbers, what in rows.items() for number in numbers.split(", ")}
    for name, rows in tables.items()
  }


def _around(words: str, figure: str) -> str:
  """Returns where a figure stands, in a few words."""
  place = max(words.find(figure.split(" ", 1)[0]) - 30, 0)
  return words[place : place + 80]


def unrecorded(
  text: str,
  name: str,
  records: Mapping[str, Record],
  allowed: Mapping[str, Mapping[str, str]],
) -> list[str]:
  """Returns what is wrong with the figures in a README's prose, a line each.

  Args:
    text: The README.
    name: Its path from the root.
    records: All records by id.
    allowed: From `read_allowed`.
  """
  problems = []
  settings = {**allowed.get("*", {}), **allowed.get(name, {})}
  for words, ids in paragraphs(text):
    unknown = [key for key in ids if key not in records]
    problems += [f"{name}: <!-- record: {key} --> names no record" for key in unknown]
    named = [records[key] for key in ids if key in records]
    for figure in figures(words):
      if figure in settings or any(matches(figure, record) for record in named):
        continue
      why = f"differs from {', '.join(ids)}" if ids else "has no record"
      problems.append(f'{name}: "{figure}" {why}: "{_around(words, figure)}"')
  return problems
