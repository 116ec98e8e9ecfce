"""What benchmarks share: turns, figures, provenance, files, and the comparison of two checkouts."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import compare, harness
from benchmarks.ledger import records as ledger

ROOT = Path(__file__).resolve().parents[2]


def test_calls_take_turns_and_slow_ones_fewer():
  order = []
  times = harness.interleave(
    {"a": lambda i: order.append(f"a{i}"), "b": lambda i: order.append(f"b{i}")},
    rounds=3,
    limits={"b": 1},
  )
  assert order == ["a0", "b0", "a0", "b0", "a1", "a2"]  # the first two warm up
  assert len(times["a"].elapsed) == 3 and len(times["b"].elapsed) == 1


def test_turns_end_when_every_call_had_its_time():
  clock = iter(range(1000))
  times = harness.interleave({"a": lambda _: next(clock)}, rounds=500, seconds=0.0)
  assert len(times["a"].elapsed) == 1


def test_percentiles_are_numpy_s():
  values = [3.0, 1.0, 7.0, 2.0, 9.0]
  for share in (0, 50, 90, 95, 100):
    assert harness.percentile(values, share) == pytest.approx(np.percentile(values, share))


def test_figures_are_for_a_unit_of_work():
  times = harness.Times(elapsed=[0.1, 0.2, 0.3], processor=[0.1, 0.1, 0.2])
  figures = times.figures(per=10)
  assert figures["median_ms"] == pytest.approx(20) and figures["p95_ms"] == pytest.approx(29)
  assert figures["processor_median_ms"] == pytest.approx(10)
  assert times.rate(per=10) == pytest.approx(30 / 0.6)


def test_machine_and_commit_are_named():
  machine = harness.machine()
  assert machine.cores == os.cpu_count() and machine.memory_gb > 0 and machine.cpu
  assert "no GPU" in str(dataclasses.replace(machine, gpu=""))
  assert "X (24 GB)" in str(dataclasses.replace(machine, gpu="X", gpu_memory_gb=24.0))
  origin = harness.provenance(7)
  git = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
  head = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
  assert origin["commit"] == (head or "unknown") and origin["seed"] == 7
  assert "numpy" in origin["versions"]


def test_a_row_that_has_other_values_starts_a_table():
  text = harness.table({"a": {"x_ms": 1.23456}, "b": {"hits": ledger.Rate(3, 4)}}, first="n")
  assert text.splitlines() == [
    "| n | x ms |",
    "| --- | --- |",
    "| a | 1.235 |",
    "",
    "| n | hits |",
    "| --- | --- |",
    "| b | 3 of 4 |",
  ]


def test_figures_are_written_as_json_and_as_a_record(tmp_path, monkeypatch):
  monkeypatch.setattr(sys, "argv", [str(ROOT / "benchmarks/x.py"), "--write", "--rounds", "2"])
  kept = []
  monkeypatch.setattr(ledger, "update", lambda *a, **k: kept.append((*a, k)))
  options = harness.Options(write=True, out=tmp_path / "x.json")
  harness.finish("x", {"a": {"t_ms": 2.0}}, options, seed=1, within="speed")
  content = json.loads((tmp_path / "x.json").read_text())
  assert content["figures"] == {"a": {"t_ms": 2.0}}
  assert content["command"] == "python benchmarks/x.py --rounds 2"
  topic, figures, origin, where = kept[0]
  assert (
    where == {"within": "speed"}
    and topic == "x"
    and figures == {"a": {"t_ms": 2.0}}
    and origin["seed"] == 1
  )


def test_nothing_is_recorded_unless_asked(tmp_path, monkeypatch):
  monkeypatch.setattr(ledger, "update", lambda *_, **__: pytest.fail("wrote a record"))
  harness.finish("x", {"a": {"t_ms": 2.0}}, harness.Options(out=tmp_path / "x.md"))
  assert "| a | 2 |" in (tmp_path / "x.md").read_text()


_SCRIPT = """
import json, os, sys
import thing
values = json.loads(sys.argv[sys.argv.index("--layout") + 1])
out = next(sys.argv[i + 1] for i, w in enumerate(sys.argv) if w in ("--out", "--output"))
open(out, "w").write(json.dumps(eval(thing.LAYOUT, {"v": thing.VALUE})))
"""


def _checkout(folder, value, layout):
  (folder / "benchmarks").mkdir(parents=True)
  (folder / "benchmarks" / "b.py").write_text(_SCRIPT)
  (folder / "thing.py").write_text(f"VALUE = {value}\nLAYOUT = {layout!r}\n")
  return folder


def test_two_checkouts_are_compared_by_the_words_of_the_names(tmp_path):
  """Each runs its own script with its own modules; the layouts of their files differ."""
  new = _checkout(
    tmp_path / "new", 2.0, "{'figures': {'task_30x40': {'steps_per_s': v}}, 'load': 9}"
  )
  layout = "{'variants': [{'name': 'task, 30x40', 'steps_per_s': v, 'z': 1}]}"
  old = _checkout(tmp_path / "old", 4.0, layout)
  rows, alone = compare.compare(
    old, ["benchmarks/b.py", "--layout", "0", "--out", "{out}"], turns=2, here=new
  )
  found = {row.name: row for row in rows}
  assert set(found) == {"figures, task 30x40, steps per s", "the whole command, s"}
  row = found["figures, task 30x40, steps per s"]
  assert row.here == [2.0, 2.0] and row.other == [4.0, 4.0] and row.ratio == 0.5
  assert alone == ["variants, task, 30x40, z"]
  assert "| 2 (2) | 4 (4) | 0.500 |" in compare.markdown([row])


def test_a_script_that_has_moved_is_found_in_the_other_checkout(tmp_path):
  checkout = _checkout(tmp_path / "old", 1.0, "v")
  words = ["benchmarks/topic/b.py", "--rounds", "2"]
  assert compare.moved(checkout, words) == ["benchmarks/b.py", "--rounds", "2"]
  assert compare.moved(checkout, ["benchmarks/none.py"]) == ["benchmarks/none.py"]
  (checkout / "benchmarks" / "other").mkdir()
  (checkout / "benchmarks" / "other" / "b.py").write_text("")
  assert compare.moved(checkout, words) == words  # which one is meant is not known


def test_a_command_that_fails_is_said_in_a_line(tmp_path, capsys):
  checkout = _checkout(tmp_path / "old", 1.0, "v")
  settings = compare.Settings(other=checkout, command="benchmarks/none.py", turns=1)
  assert compare.main(settings) == 1
  assert "benchmarks/none.py failed in" in capsys.readouterr().out


def test_a_script_s_command_loses_other_and_gains_out(tmp_path):
  words = [str(ROOT / "benchmarks/simulation/env.py"), "--rounds", "2", "--other", "x", "--turns=4"]
  assert (
    compare.own_command(words, tmp_path) == "benchmarks/simulation/env.py --rounds 2 --out {out}"
  )


def test_a_record_s_command_names_no_folder_of_a_machine(monkeypatch):
  words = [f"--sets={ROOT}/out/x", "--out", "/home/somebody/project/out/y", "--write", "--seed=7"]
  monkeypatch.setattr(sys, "argv", [str(ROOT / "benchmarks" / "identify.py"), *words])
  assert harness.command_line() == (
    "python benchmarks/identify.py --sets=out/x --out out/y --seed=7"
  )


def test_no_tracked_text_names_a_machine_s_folders():
  found = subprocess.run(
    ["git", "grep", "-lE", "/(work|root)/[a-z]+/", "--", "*.json", "*.md"],
    cwd=ROOT,
    capture_output=True,
    text=True,
    check=False,
  )
  if found.returncode > 1:
    pytest.skip("not a git checkout")
  assert found.stdout.split() == []


@pytest.mark.parametrize("error", [ValueError("Found no sets."), OSError("Found no sets.")])
def test_what_the_user_can_mend_ends_in_one_line(error, monkeypatch):
  def main(_):
    raise error

  monkeypatch.setattr(sys, "argv", ["benchmark"])
  with pytest.raises(SystemExit, match="^error: Found no sets.$"):
    harness.run(main, harness.Options, None)
