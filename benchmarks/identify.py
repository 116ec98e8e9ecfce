"""Judges the analyser on blind sets: `python benchmarks/identify.py`.

Runs `launch/identify.py` on every set of a folder made by `make_blind_sets.py` (made first if it is
not there), compares the reports with answers.json, prints the table and the confusions, and keeps
both in the generator's folder of `benchmarks/results/analyser/`. Sets that were analysed already
are not analysed again, so it can be stopped and run on. Seeds 100 to 199 are for development;
figures are reported of others.
"""

import concurrent.futures
import dataclasses
import json
import os
import pathlib
import resource
import signal
import subprocess
import sys
import time
from typing import Any, Literal

from benchmarks import harness
from benchmarks.blind_sets import apparatus, scoring
from benchmarks.drive_axes import plants as axes
from benchmarks.hobby_joints import machines as hobby
from benchmarks.independent_sets import apparatus as independent
from benchmarks.ledger.records import ROOT
from benchmarks.servo_bench import bench
from nerf2real.core import markdown

RESULTS = ROOT / "benchmarks" / "results" / "analyser"
FOLDERS = {
  **{"blind_sets": "first", "independent_sets": "second", "servo_bench": "third"},
  **{"drive_axes": "fourth", "hobby_joints": "fifth"},
}
"""Folder of a generator's pages, there and in the records."""
_PLANTS = {
  "blind_sets": apparatus.KINDS,
  "independent_sets": independent.KINDS,
  "servo_bench": bench.PLANTS,
  "drive_axes": axes.PLANTS,
  "hobby_joints": hobby.PLANTS,
}


@dataclasses.dataclass(frozen=True)
class Settings:
  """Arguments of the benchmark."""

  sets: pathlib.Path = pathlib.Path("out/blind")
  """Folder of sets with answers.json."""
  out: pathlib.Path = pathlib.Path("out/identified")
  """Folder for the analyser's reports."""
  seed: int = 7001
  """Seed of the sets where they must be made."""
  count: int = 72
  """Number of sets where they must be made."""
  generator: Literal[
    "blind_sets", "independent_sets", "servo_bench", "drive_axes", "hobby_joints"
  ] = "blind_sets"
  """Which package makes them."""
  references: bool = True
  """Give the analyser the reference logs that a set has."""
  only: tuple[str, ...] = ()
  """Names of sets; empty: all."""
  processes: int = 2
  """Sets analysed at the same time, each on one core."""
  timeout: float = 900.0
  """s that one analysis may take; longer is a failure."""
  processor_seconds: int | None = None
  """s of processor time that one analysis may use; more is a failure. No limit for None."""
  pool: tuple[str, ...] = ()
  """Analyse nothing: put kept pages' scores together, such as `third/9115 fourth/7501`."""
  done_only: bool = False
  """Analyse nothing: score what was analysed so far."""
  redo: bool = False
  """Analyse again what was analysed."""
  name: str = "identify"
  """Topic of the records; without `identify_` the name of the table and the scores."""
  results: pathlib.Path | None = None
  """Folder of the table and the scores; the generator's in benchmarks/results/analyser for None."""
  write: bool = False
  """Keep the figures as records in benchmarks/results/records/."""


def main(settings: Settings) -> None:
  """Makes sets if needed, analyses them, prints and keeps the table."""
  if settings.pool:
    _pool(settings)
    return
  if not (settings.sets / "answers.json").is_file():
    _run(
      [
        *(sys.executable, str(ROOT / "benchmarks/make_blind_sets.py")),
        *("--out", str(settings.sets), "--seed", str(settings.seed)),
        *("--count", str(settings.count), "--generator", settings.generator),
      ]
    )
  answers = json.loads((settings.sets / "answers.json").read_text())
  unknown = [name for name in settings.only if name not in answers]
  if unknown:
    raise ValueError(f"Found no sets {unknown} in {settings.sets}, expected some of its answers.")
  names = [name for name in answers if not settings.only or name in settings.only]
  if settings.done_only:
    names = [name for name in names if (settings.out / name / "harness.json").is_file()]
    if not names:
      raise ValueError(f"Found no analysed set in {settings.out}, run without --done-only first.")
  rows: list[dict[str, Any]] = []
  with concurrent.futures.ThreadPoolExecutor(settings.processes) as pool:
    futures = {pool.submit(_analyse, settings, name): name for name in names}
    for future in concurrent.futures.as_completed(futures):
      name = futures[future]
      report, used = future.result()
      score = scoring.score(answers[name], report)
      rows.append({"set": name, "plant": answers[name]["plant"], "used": used, "score": score})
      print(f"{name} {answers[name]['plant']}: {score.truth} -> {score.said}", flush=True)
  rows.sort(key=lambda row: row["set"])
  text = render(rows, answers)
  print(text)
  part, page = folder_of(answers, settings.generator), settings.name.removeprefix("identify_")
  folder = settings.results or RESULTS / part
  folder.mkdir(parents=True, exist_ok=True)
  (folder / f"{page}.md").write_text(text)
  record = {
    "sets": [row["set"] for row in rows],
    "figures": [dataclasses.asdict(row) for row in scoring.table([r["score"] for r in rows])],
    "scores": [{**row, "score": dataclasses.asdict(row["score"])} for row in rows],
    "answers": {name: answers[name] for name in names},
  }
  (folder / f"{page}.json").write_text(json.dumps(record, indent=1) + "\n")
  seeds = ", ".join(sorted({name.split("_")[0] for name in names}))
  options = harness.Options(write=settings.write)
  harness.finish(settings.name, figures_of(rows), options, seed=seeds, within=f"analyser/{part}")


def _pool(settings: Settings) -> None:
  """Prints and keeps the table of several runs together, and the figures of each generator's."""
  parts: dict[str, list[dict[str, Any]]] = {}
  for page in settings.pool:
    path = RESULTS / f"{page}.json"
    if not path.is_file():
      raise ValueError(f"Found no {path}, expected pages such as fourth/7501 after --pool.")
    scores = json.loads(path.read_text())["scores"]
    part = parts.setdefault(page.split("/")[0], [])
    part += [row | {"score": scoring.Score(**row["score"])} for row in scores]
  rows = [row for part in parts.values() for row in part]
  text = render(rows, {row["set"]: {} for row in rows})
  print(text)
  folder = settings.results or RESULTS
  (folder / f"{settings.name.removeprefix('identify_')}.md").write_text(text)
  options = harness.Options(write=settings.write)
  for name, part in {"": rows, **parts}.items():
    pages = [page for page in settings.pool if page.startswith(name)]
    harness.finish(
      f"{settings.name}_{name}".rstrip("_"),
      figures_of(part),
      options,
      seed=", ".join(page.split("/")[-1] for page in pages),
      within="analyser",
    )


def folder_of(answers: dict[str, Any], generator: str) -> str:
  """Returns the folder of the generator whose plants the sets have, `generator` if several have."""
  plants = {answer["plant"] for answer in answers.values()}
  makers = [name for name, kinds in _PLANTS.items() if plants <= set(kinds)]
  return FOLDERS[generator if generator in makers or not makers else makers[0]]


def figures_of(rows: list[dict[str, Any]]) -> dict[str, dict[str, harness.Value]]:
  """Returns the figures of the table; shares as rates with their number of cases."""
  figures: dict[str, dict[str, harness.Value]] = {}
  for figure in scoring.table([row["score"] for row in rows]):
    if figure.value is None:
      continue
    value: harness.Value = figure.value
    if "%" in figure.target:
      value = harness.Rate(round(figure.value * figure.of), figure.of)
    figures[figure.question] = {"value": value, "of": figure.of}
    if "relative" in figure.question:
      figures[figure.question]["percent"] = 100 * figure.value
  for plant in sorted({row["plant"] for row in rows}):
    used = [row["used"]["wall_s"] for row in rows if row["plant"] == plant]
    times = {"median_s": harness.percentile(used, 50), "longest_s": max(used), "sets": len(used)}
    figures[f"seconds {plant}"] = dict(times)
  return figures


def _analyse(settings: Settings, name: str) -> tuple[dict[str, Any], dict[str, float]]:
  """Returns a set's report and the time that it took; a failure is `{"failed": message}`."""
  folder, out = settings.sets / name, settings.out / name
  done = out / "harness.json"
  if done.is_file() and not settings.redo:
    kept = json.loads(done.read_text())
    return kept["report"], kept["used"]
  out.mkdir(parents=True, exist_ok=True)
  command = [sys.executable, str(ROOT / "launch/identify.py"), "--model", str(folder / "model.xml")]
  for option, pattern in (("logs", "train"), ("held", "held"), ("reference", "reference")):
    if option == "reference" and not settings.references:
      continue
    paths = sorted(str(path) for path in folder.glob(f"{pattern}_*.mcap"))
    command += [f"--{option}", *paths] if paths else []
  command += ["--out", str(out)]
  if settings.processor_seconds is not None:
    command = ["sh", "-c", f'ulimit -t {settings.processor_seconds}; exec "$@"', "sh", *command]
  before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
  report: dict[str, Any] = {}
  try:
    result = subprocess.run(
      command,
      capture_output=True,
      text=True,
      timeout=settings.timeout,
      check=False,
      env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    if result.returncode in (-signal.SIGXCPU, -signal.SIGKILL) and settings.processor_seconds:
      report = {"failed": f"used more than {settings.processor_seconds} s of processor time"}
    elif result.returncode:
      lines = result.stderr.strip().splitlines() or ["no message"]
      report = {"failed": lines[-1]}
    else:
      report = json.loads((out / "report.json").read_text())
  except subprocess.TimeoutExpired:
    report = {"failed": f"took longer than {settings.timeout:g} s"}
  after = resource.getrusage(resource.RUSAGE_CHILDREN)
  used = {"wall_s": time.perf_counter() - start}
  if settings.processes == 1:  # otherwise the children's times are mixed
    used["cpu_s"] = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
  done.write_text(json.dumps({"report": report, "used": used}))
  return report, used


def _run(command: list[str]) -> None:
  subprocess.run(command, check=True)


def render(rows: list[dict[str, Any]], answers: dict[str, Any]) -> str:
  """Returns the table, the confusions and how they came about, as Markdown."""
  origin = harness.provenance()
  scores: list[scoring.Score] = [row["score"] for row in rows]
  mixes = {
    mix: sum(s.mix == mix for s in scores) for mix in ("single", "pair", "outside", "healthy")
  }
  plants = {p: sum(r["plant"] == p for r in rows) for p in sorted({r["plant"] for r in rows})}
  lines = [
    "# The analyser on blind sets",
    "",
    f"`python benchmarks/identify.py`, {origin['date']}, {origin['machine']}, commit "
    f"{origin['commit']}. {len(rows)} of {len(answers)} sets of seeds "
    f"{', '.join(sorted({name.split('_')[0] for name in answers}))}: "
    + ", ".join(f"{n} {mix}" for mix, n in mixes.items())
    + "; "
    + ", ".join(f"{n} {plant}" for plant, n in plants.items())
    + f". {sum(s.below_floor for s in scores)} with effects below the floor, in no figure.",
    "",
  ]
  found: list[tuple[object, ...]] = []
  for figure in scoring.table(scores):
    value = "-" if figure.value is None else f"{figure.value:.3g}"
    if figure.value is not None and "%" in figure.target:
      rate = harness.Rate(round(figure.value * figure.of), figure.of)
      value = f"{rate:.0f} % ({rate.span})"
    met = {True: "yes", False: "no", None: "-"}[figure.met]
    found.append((figure.question, value, figure.of, figure.target, met))
  for plant in plants:
    for key, words in (("wall_s", "seconds"), ("cpu_s", "processor seconds")):
      used = sorted(r["used"][key] for r in rows if r["plant"] == plant and key in r["used"])
      if used:
        name = f"{plant}: {words} a set, median (most {used[-1]:.0f})"
        found.append((name, f"{used[len(used) // 2]:.0f}", len(used), "-", "-"))
  heads = ("figure", "measured (exact 95 %)", "of", "target", "met")
  lines += [markdown.table(heads, found)]
  said = []
  for row in rows:
    s = row["score"]
    right = _right(s)
    note = " (below the floor)" if s.below_floor else ""
    mark = {True: "yes", False: "**no**", None: "-"}[right]
    said.append((f"{row['set']} {row['plant']}", f"{s.truth}{note}", s.said, mark))
  table = markdown.table(("set", "is", "said", "right"), said)
  lines += ["", "## What was said of what", "", table]
  return "\n".join(lines) + "\n"


def _right(score: scoring.Score) -> bool | None:
  """Returns whether a set was answered as its mix requires."""
  if score.below_floor:
    return None
  if score.mix == "healthy":
    return not score.accused
  if score.mix == "outside":
    return score.unexplained
  if score.mix == "pair":
    return bool(score.all_right and score.none_wrong)
  return bool(score.right_first and score.none_wrong)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
