"""How reports are compared with truths, on reports written by hand."""

import dataclasses
import json
import pathlib
import subprocess
import sys

import pytest

from benchmarks.blind_sets import effects, scoring
from nerf2real.suite.effects import KINDS


def _truth(mix, *found, **more):
  return {"mix": mix, "effects": list(found), "below_floor": False, **more}


def _report(*found, verdict=None, **more):
  return {"verdict": verdict or ("effects" if found else "none"), "effects": list(found), **more}


def _effect(kind, joint="elbow", **parameters):
  values = {n: {"value": v, "low": 0.9 * v, "high": 1.1 * v} for n, v in parameters.items()}
  return {"kind": kind, "joint": joint, "parameters": values}


DELAY = {"kind": "command_delay", "joint": "elbow", "delay": 0.03}
FRICTION = {"kind": "coulomb_friction", "joint": "wrist", "torque": 0.2}
SPOT = {"kind": "sticking_spot", "joint": "elbow", "depth": 0.4, "in_library": False}
CONSTANTS = _effect("parameter_error", None, damping=1.1)


def test_a_right_name():
  score = scoring.score(
    _truth("single", DELAY, healthy_held_error=0.002),
    _report(
      _effect("command_delay", delay=0.0315),
      CONSTANTS,
      error={"held": {"before": 0.04, "after": 0.004}, "floor": 0.0025},
    ),
  )
  assert score.right_first and score.right_joint and score.none_wrong
  assert score.size_errors == pytest.approx([0.05]) and score.covered == [True]
  assert score.gain == pytest.approx(10) and score.over_floor == pytest.approx(1.6)
  assert score.over_healthy == pytest.approx(2)


@pytest.mark.parametrize(
  ("kinds", "confounded", "joint", "alike"),
  [
    (["command_delay"], True, "elbow", True),
    (["command_delay"], False, "elbow", False),
    (["command_delay", "backlash"], True, "elbow", False),
    (["command_delay"], True, "wrist", False),
  ],
)
def test_a_name_that_is_listed_as_predicting_the_same(kinds, confounded, joint, alike):
  other = {"kinds": kinds, "confounded": confounded, "joint": joint}
  report = _report(_effect("measurement_delay", delay=0.03), alternatives=[other])
  score = scoring.score(_truth("single", DELAY), report)
  assert (score.right_first, score.right_or_alike) == (False, alike)
  assert scoring.score(_truth("single", DELAY), _report(_effect("command_delay"))).right_or_alike


@pytest.mark.parametrize(
  ("report", "first", "joint", "clean"),
  [
    (_report(_effect("measurement_delay")), False, True, False),
    (_report(_effect("command_delay", "wrist", delay=0.03)), True, False, False),
    (_report(CONSTANTS, _effect("command_delay", delay=0.03)), True, True, True),
    (_report(CONSTANTS), False, False, True),
    (_report(verdict="unexplained", residual_at={"joint": "elbow"}), False, True, True),
    (_report(_effect("command_delay", delay=0.03), _effect("spring")), True, True, False),
    ({"failed": "no message"}, False, False, True),
  ],
)
def test_wrong_answers_to_one_effect(report, first, joint, clean):
  score = scoring.score(_truth("single", DELAY), report)
  assert (score.right_first, score.right_joint, score.none_wrong) == (first, joint, clean)


def test_a_size_at_another_joint_is_no_size():
  report = _report(_effect("command_delay", "wrist", delay=0.03))
  assert scoring.score(_truth("single", DELAY), report).size_errors == []


def test_a_payload_may_be_named_by_its_body():
  truth = {"kind": "payload", "joint": "elbow", "body": "forearm", "mass": 0.2, "pos": [0, 0, 0]}
  found = {**_effect("payload", None, mass=0.25), "body": "forearm"}
  score = scoring.score(_truth("single", truth), _report(found))
  assert score.right_joint and score.size_errors == pytest.approx([0.25])
  assert score.covered == [False]


def test_constants_that_are_off_must_be_named_where_they_are_the_truth():
  truth = {"kind": "parameter_error", "joint": None, "damping": 1.1, "armature": 0.9}
  score = scoring.score(_truth("single", truth), _report(CONSTANTS))
  assert score.right_first and score.right_joint is None
  wrong = scoring.score(_truth("single", truth), _report(_effect("viscous_friction")))
  assert not wrong.right_first and not wrong.none_wrong


def test_heat_counts_by_what_it_costs():
  truth = {"kind": "thermal_derating", "joint": "elbow", "heating": 1.0, "derating": 0.004}
  found = _effect("thermal_derating", heating=0.5, derating=0.008)
  score = scoring.score(_truth("single", truth), _report(found))
  assert score.size_errors == pytest.approx([0.0]) and score.covered == [True]


def test_healthy_machines():
  truth = _truth("healthy")
  assert scoring.score(truth, _report()).accused is False
  assert scoring.score(truth, _report(CONSTANTS)).accused is False
  assert scoring.score(truth, _report(_effect("spring"))).accused is True
  assert scoring.score(truth, _report(verdict="unexplained")).accused is True


def test_pairs():
  truth = _truth("pair", DELAY, FRICTION)
  both = _report(_effect("coulomb_friction", "wrist", torque=0.2), _effect("command_delay"))
  assert scoring.score(truth, both).all_right and scoring.score(truth, both).none_wrong
  one = scoring.score(truth, _report(_effect("command_delay")))
  assert not one.all_right and one.none_wrong and one.right_joint
  third = scoring.score(truth, _report(*both["effects"], _effect("spring")))
  assert third.all_right and not third.none_wrong


def test_what_no_library_has():
  right = scoring.score(_truth("outside", SPOT), _report(verdict="unexplained"))
  wrong = scoring.score(_truth("outside", SPOT), _report(_effect("coulomb_friction")))
  assert right.unexplained and right.none_wrong
  assert not wrong.unexplained and not wrong.none_wrong


def test_the_table_leaves_out_what_cannot_be_seen():
  good = scoring.score(_truth("single", DELAY), _report(_effect("command_delay", delay=0.03)))
  hidden = scoring.score(_truth("single", DELAY, below_floor=True), _report())
  healthy = scoring.score(_truth("healthy"), _report())
  accused = dataclasses.replace(healthy, accused=True)
  rows = {row.question: row for row in scoring.table([good, hidden, healthy, accused])}
  assert rows["single: right name first"].value == 1 and rows["single: right name first"].of == 1
  assert rows["healthy: accused"].value == 0.5 and rows["healthy: accused"].met is False
  assert rows["pair: both right"].value is None and rows["pair: both right"].met is None
  assert rows["sizes: relative error, median"].met


def test_truths_use_the_names_that_reports_use():
  """Kinds and sizes of the generator are kinds and parameters of the suite's effects."""
  for kind in effects.LIBRARY:
    known = {parameter.name for parameter in KINDS[kind].parameters}
    assert set(scoring.SIZES[kind]) <= known
    assert kind == "motor_gain" or not set(effects.LIBRARY[kind].strength) - known - {"limit"}
  assert not set(effects.OUTSIDE) & set(KINDS)


def test_the_harness_scores_kept_reports(tmp_path):
  """Sets that were analysed are not analysed again; table and scores are written."""
  root = pathlib.Path(__file__).resolve().parents[2]
  truths = {"5_000": _truth("single", DELAY), "5_001": _truth("healthy")}
  answers = {name: {**truth, "plant": "pendulum"} for name, truth in truths.items()}
  reports = {
    "5_000": _report(_effect("command_delay", delay=0.03)),
    "5_001": _report(_effect("spring")),
  }
  for name, report in reports.items():
    (tmp_path / "out" / name).mkdir(parents=True)
    kept = {"report": report, "used": {"wall_s": 12.0}}
    (tmp_path / "out" / name / "harness.json").write_text(json.dumps(kept))
  (tmp_path / "sets").mkdir()
  (tmp_path / "sets" / "answers.json").write_text(json.dumps(answers))
  subprocess.run(
    [
      sys.executable,
      str(root / "benchmarks/identify.py"),
      "--sets",
      str(tmp_path / "sets"),
      "--out",
      str(tmp_path / "out"),
      "--results",
      str(tmp_path),
      "--done-only",
    ],
    check=True,
    capture_output=True,
    timeout=60,
  )
  text = (tmp_path / "identify.md").read_text()
  assert "| single: right name first | 100 % (3 to 100 %) | 1 | >= 95 % | yes |" in text
  assert "| healthy: accused | 100 % (3 to 100 %) | 1 | <= 2 % | no |" in text
  assert "| 5_001 pendulum | nothing | spring@elbow | **no** |" in text
  scores = json.loads((tmp_path / "identify.json").read_text())["scores"]
  assert [row["set"] for row in scores] == ["5_000", "5_001"]
