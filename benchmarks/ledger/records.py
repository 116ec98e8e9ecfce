"""Keeps every published figure as a record: values, unit, command, commit, machine, date, caveats.

A file in a folder of `benchmarks/results/records/` holds the list of records of one benchmark or
topic. Scripts write there with `--write` (`benchmarks.harness`), each topic where its file is;
`benchmarks/tables.py` prints the records into the READMEs and `docs/figures/`.
"""

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RECORDS = ROOT / "benchmarks" / "results" / "records"
UNKNOWN = "unknown"

# A value's name ends in its unit.
_UNITS = {
  "per_second": "1/s",
  "per_s": "1/s",
  "percent": "%",
  "degrees": "degrees",
  "times": "times",
  **{unit.lower(): unit for unit in ("us", "ms", "s", "mm", "cm", "m", "mrad", "rad", "px", "dB")},
}


@dataclasses.dataclass(frozen=True)
class Rate:
  """`count` of `of` trials; printed as a percentage."""

  count: int
  of: int

  def __format__(self, spec: str) -> str:
    """Returns the percentage in a number's format, such as ".0f"."""
    return format(100 * self.count / self.of, spec)

  @property
  def interval(self) -> tuple[float, float]:
    """The exact 95 % interval of the probability."""
    from nerf2real.core.intervals import clopper_pearson  # late: numpy comes after threads are set

    return clopper_pearson(self.count, self.of)

  @property
  def span(self) -> str:
    """That interval in words."""
    low, high = self.interval
    return f"{100 * low:.0f} to {100 * high:.0f} %"

  def to_dict(self) -> dict[str, Any]:
    """Returns the rate as it is kept."""
    interval = [round(bound, 4) for bound in self.interval]
    return {"count": self.count, "of": self.of, "interval_95": interval}


Value = float | int | str | Rate


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
  """A figure, or a few that one measurement gave, and where they come from."""

  id: str
  """Topic (name of the file), a dot, and a name."""
  what: str
  """What was measured, in words."""
  values: Mapping[str, Value]
  """The figures by name, as exactly as they are known."""
  unit: Mapping[str, str]
  """Unit of every value that has one; a `Rate` carries its n and interval."""
  found: str
  """How the values are printed: a format string over their names."""
  asked: str = ""
  """The requirement; empty: none."""
  command: str
  """Command line from the root."""
  commit: str
  """Code that was measured, "unknown" if that was not noted."""
  dirty: bool | None = None
  """Whether that tree held changes that were not committed; None: not noted."""
  stated_in: str = ""
  """Commit that first states the figure, where the one that was measured was not noted."""
  machine: str
  """Processor, cores, memory, GPU."""
  date: str
  """Day of the measurement."""
  seed: int | str | None = None
  """Of what is random; None: nothing is, or it was not noted."""
  versions: Mapping[str, str] | None = None
  """Of the packages that matter; None: not noted."""
  load: float | None = None
  """Load average of the machine; None: not noted."""
  caveats: tuple[str, ...] = ()
  """Caveats."""
  evidence: tuple[str, ...] = ()
  """Files with more, from the root."""
  measured_again: bool = False
  """Whether it was measured since the code moved (`tables.MOVE`)."""

  @property
  def printed(self) -> str:
    """The figure as text."""
    return self.found.format(**self.values)

  def to_dict(self) -> dict[str, Any]:
    """Returns the record as it is kept: what was not noted and is empty is left out."""
    content = {
      field.name: getattr(self, field.name)
      for field in dataclasses.fields(self)
      if getattr(self, field.name) != field.default
    }
    content["values"] = {
      name: value.to_dict() if isinstance(value, Rate) else value
      for name, value in self.values.items()
    }
    return content | {"measured_again": self.measured_again}

  @classmethod
  def from_dict(cls, content: dict[str, Any], *, source: str) -> "Record":
    """Returns a record that was kept.

    Raises:
      ValueError: Fields are missing or unknown, or the figure cannot be printed.
    """
    values = {name: _value(value) for name, value in content.get("values", {}).items()}
    lists = {name: tuple(content.get(name, ())) for name in ("caveats", "evidence")}
    try:
      record = cls(**{**content, **lists, "values": values})
      _ = record.printed
    except (TypeError, KeyError, AttributeError, ValueError) as error:
      raise ValueError(f"{source}: record {content.get('id', content)!r}: {error}") from error
    return record


def _value(content: Any) -> Value:
  return Rate(content["count"], content["of"]) if isinstance(content, dict) else content


def read(folder: Path = RECORDS) -> dict[str, Record]:
  """Returns all records by id, in the order of the files' names; folders do not matter.

  Raises:
    ValueError: A record is not complete, stands twice, or has another topic than its file.
  """
  records: dict[str, Record] = {}
  for path in sorted(folder.rglob("*.json"), key=lambda path: path.name):
    for content in json.loads(path.read_text()):
      record = Record.from_dict(content, source=path.name)
      if record.id in records or not record.id.startswith(f"{path.stem}."):
        raise ValueError(
          f"{path.name}: found id {record.id!r}; expected one of its own that starts with "
          f"{path.stem + '.'!r}."
        )
      records[record.id] = record
  return records


def folders(folder: Path = RECORDS) -> dict[str, str]:
  """Returns the folders of each topic, joined by an underscore."""
  paths = list(folder.rglob("*.json"))
  return {path.stem: "_".join(path.relative_to(folder).parts[:-1]) for path in paths}


def path_of(topic: str, folder: Path = RECORDS, within: str = "") -> Path:
  """Returns where a topic's file is, in whichever folder; a new topic's goes into `within`.

  Raises:
    ValueError: It is in two folders.
  """
  found = sorted(folder.rglob(f"{topic}.json"))
  if len(found) > 1:
    places = ", ".join(str(path.relative_to(folder)) for path in found)
    raise ValueError(f"Found {places}; expected one file of topic {topic!r}.")
  return found[0] if found else folder / within / f"{topic}.json"


def write(records: list[Record], topic: str, folder: Path = RECORDS, within: str = "") -> Path:
  """Writes the file of a topic at its `path_of`; returns its path."""
  path = path_of(topic, folder, within)
  path.parent.mkdir(parents=True, exist_ok=True)
  rows = [record.to_dict() for record in records]
  path.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n")
  return path


def update(
  topic: str,
  figures: Mapping[str, Mapping[str, Value]],
  provenance: Mapping[str, Any],
  *,
  folder: Path = RECORDS,
  within: str = "",
) -> Path:
  """Writes what was just measured into a topic's records.

  A record that is there keeps its words (what, found, asked); its caveats and evidence belonged to
  the older measurement and go.

  Args:
    topic: Name of the file.
    figures: Values by name of the record, without the topic.
    provenance: From `harness.provenance`.
    folder: Where the records are.
    within: Folder in it for a topic that has no file yet.
  """
  path = path_of(topic, folder)
  content = json.loads(path.read_text()) if path.is_file() else []
  kept = {row["id"]: Record.from_dict(row, source=path.name) for row in content}
  fields = {field.name for field in dataclasses.fields(Record)}
  origin = {name: value for name, value in provenance.items() if name in fields}
  for name, values in figures.items():
    key = f"{topic}.{slug(name)}"
    old = kept.get(key)
    known = old is not None and set(values) >= set(old.values)
    kept[key] = Record(
      id=key,
      what=old.what if old else f"{topic}, {name.replace('_', ' ')}",
      values=dict(values),
      unit=(dict(old.unit) if old else {}) | {n: u for n in values if (u := unit_of(n))},
      found=old.found if old and known else default_format(values),
      asked=old.asked if old else "",
      measured_again=True,
      **origin,
    )
  return write(list(kept.values()), topic, folder, within)


def slug(name: str) -> str:
  """Returns a name as part of an id: lower case, words joined by underscores."""
  return re.sub(r"[^a-z0-9.]+", "_", name.lower()).strip("_")


def unit_of(name: str) -> str:
  """Returns the unit that a value's name ends in; empty: none."""
  return next((unit for end, unit in _UNITS.items() if f"_{name}".endswith(f"_{end}")), "")


def default_format(values: Mapping[str, Value]) -> str:
  """Returns a format string that prints every value with its name."""
  cells = []
  for name, value in values.items():
    if isinstance(value, Rate):
      cells.append(f"{name.replace('_', ' ')} {{{name}.count}} of {{{name}.of}}")
    elif isinstance(value, str):
      cells.append(f"{name.replace('_', ' ')} {{{name}}}")
    else:
      unit = unit_of(name)
      words = name.removesuffix(f"_{unit.lower()}").replace("_", " ")
      cells.append(f"{words} {{{name}:{'' if isinstance(value, int) else '.4g'}}} {unit}".rstrip())
  return ", ".join(cells)
