"""Records: what they need, how they are printed, what a new measurement replaces."""

import json

import pytest

from benchmarks.ledger import records as ledger
from benchmarks.ledger.records import Rate, Record

ORIGIN = {
  "command": "python benchmarks/x.py",
  "commit": "abc1234",
  "dirty": False,
  "machine": "m",
  "date": "2026-01-01",
  "seed": 3,
  "versions": {"numpy": "2"},
  "load": 0.5,
}


def _record(name="x.a", **changes):
  fields = {
    "id": name,
    "what": "speed",
    "values": {"t_ms": 2.345},
    "unit": {"t_ms": "ms"},
    "found": "{t_ms:.1f} ms",
    "asked": "3 ms",
    **{key: ORIGIN[key] for key in ("command", "commit", "machine", "date")},
    **changes,
  }
  return Record(**fields)


def test_records_come_back_as_they_were_written(tmp_path):
  records = [
    _record(caveats=("a",), evidence=("README.md",)),
    _record("x.b", values={"hits": Rate(9, 10)}, unit={}, found="{hits:.0f} %", seed=1),
  ]
  ledger.write(records, "x", tmp_path)
  assert list(ledger.read(tmp_path).values()) == records
  assert [r.printed for r in records] == ["2.3 ms", "90 %"]


def test_a_rate_has_its_number_and_its_interval():
  kept = Rate(54, 54).to_dict()
  assert (kept["count"], kept["of"]) == (54, 54)
  # no failure in n: the lower bound is (0.025)^(1/n)
  assert kept["interval_95"] == [pytest.approx(0.025 ** (1 / 54), abs=1e-4), 1.0]
  assert f"{Rate(1, 3):.1f}" == "33.3"


@pytest.mark.parametrize(
  ("change", "message"),
  [
    ({"id": "y.a"}, "starts with 'x.'"),
    ({"found": "{other} ms"}, "other"),
    ({"command": None}, "command"),
    ({"unheard": 1}, "unheard"),
  ],
)
def test_a_record_that_is_not_right_is_named(tmp_path, change, message):
  content = {**_record().to_dict(), **change}
  content = {name: value for name, value in content.items() if value is not None}
  (tmp_path / "x.json").write_text(json.dumps([content]))
  with pytest.raises(ValueError, match=message):
    ledger.read(tmp_path)


def test_a_record_stands_once(tmp_path):
  (tmp_path / "x.json").write_text(json.dumps([_record().to_dict()] * 2))
  with pytest.raises(ValueError, match=r"x\.a"):
    ledger.read(tmp_path)


def test_a_new_measurement_keeps_the_words_and_replaces_the_rest(tmp_path):
  ledger.write([_record(caveats=("old machine",)), _record("x.b")], "x", tmp_path)
  ledger.update(
    "x", {"a": {"t_ms": 1.0, "p95_ms": 4.0}, "New one": {"n": 3}}, ORIGIN, folder=tmp_path
  )
  records = ledger.read(tmp_path)
  assert list(records) == ["x.a", "x.b", "x.new_one"]
  new = records["x.a"]
  assert (new.what, new.asked, new.printed) == ("speed", "3 ms", "1.0 ms")
  assert new.unit == {"t_ms": "ms", "p95_ms": "ms"}
  assert (new.caveats, new.measured_again, new.commit, new.seed) == ((), True, "abc1234", 3)
  assert records["x.b"] == _record("x.b")
  assert records["x.new_one"].printed == "n 3"


def test_a_topic_is_found_and_written_in_its_folder(tmp_path):
  ledger.write([_record("b.a")], "b", tmp_path, "first")
  ledger.write([_record("a.a")], "a", tmp_path / "second")
  assert list(ledger.read(tmp_path)) == ["a.a", "b.a"]  # by name, whatever the folder
  for topic, path in {"b": "first/b.json", "c": "third/c.json"}.items():
    written = ledger.update(topic, {"n": {"n": 1}}, ORIGIN, folder=tmp_path, within="third")
    assert written == tmp_path / path
  assert list(ledger.read(tmp_path)) == ["a.a", "b.a", "b.n", "c.n"]


def test_a_topic_has_one_file(tmp_path):
  ledger.write([_record()], "x", tmp_path / "first")
  ledger.write([_record()], "x", tmp_path / "second")
  with pytest.raises(ValueError, match=r"first/x\.json, second/x\.json"):
    ledger.write([_record()], "x", tmp_path)


def test_a_name_s_end_is_its_unit():
  units = {"median_ms": "ms", "psnr_db": "dB", "steps_per_s": "1/s", "worst_degrees": "degrees"}
  assert {name: ledger.unit_of(name) for name in units} == units
  assert ledger.unit_of("views") == ""


def test_all_records_say_where_they_come_from():
  """A figure whose commit was not noted says so, and names the commit that first states it."""
  for record in ledger.read().values():
    assert record.command and record.machine and record.date, record.id
    if record.commit == ledger.UNKNOWN:
      assert record.stated_in and any("commit" in c for c in record.caveats), record.id
    for name, value in record.values.items():
      assert isinstance(value, str | int | float | Rate), (record.id, name)
