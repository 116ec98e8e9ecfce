"""Gains of many servos as one entry of what is read."""

from nerf2real.sysid.report.alike import together


def _gain(joint, value):
  interval = {"value": value, "low": value - 0.01, "high": value + 0.02, "unit": "1"}
  evidence = {"servo_law": True, "clear_by_standard_errors": 10.0 * value}
  return {
    "kind": "motor_gain",
    "joint": joint,
    "parameters": {"gain": interval},
    "evidence": evidence,
  }


_LOAD = {"kind": "payload", "joint": "a", "parameters": {}, "evidence": {}}


def test_gains_that_are_alike_are_one_entry():
  entries = [_LOAD, *(_gain(n, v) for n, v in zip("abcd", (0.88, 0.9, 0.89, 0.6), strict=True))]
  before = [dict(e) for e in entries]
  load, one, other = together([*entries[:4], entries[4]])
  assert load is _LOAD and other is entries[4]
  assert one["joint"] == "3 joints"
  assert one["parameters"]["gain"] == {"value": 0.89, "low": 0.87, "high": 0.92, "unit": "1"}
  assert one["evidence"]["clear_by_standard_errors"] == 8.8
  assert entries == before


def test_few_gains_and_other_kinds_stay_as_they_are():
  entries = [_gain("a", 0.9), _gain("b", 0.9), _LOAD]
  assert together(entries) == entries
  weak = [{**_gain(n, 0.9), "evidence": {}} for n in "abcd"]
  assert together(weak) == weak
