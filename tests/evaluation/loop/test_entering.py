"""What of a finding enters the simulation."""

import json
from pathlib import Path

import pytest

from nerf2real.evaluation.loop import naming, telling
from nerf2real.evaluation.loop.entering import (
  CLAIMED,
  FITTED_BESIDE,
  OWN,
  entering,
  forces,
  reasons,
)
from nerf2real.suite.effects import Effect, read_effects, write_effects

FORCE = Effect("residual_force", "l_knee", {"weights": [0.1] * 400})
MODEL = [
  Effect("parameter_error", "l_knee", {"gain": 0.98}, samples={"gain": [0.97, 0.99]}),
  Effect("parameter_error", "r_knee", {"gain": 0.9}),
  Effect("motor_gain", "l_knee", {"gain": 0.16}, {"gain": (0.15, 0.17)}),
  Effect("load_friction", "l_knee", {"coefficient": 0.3}, {"coefficient": (0.2, 0.4)}),
  FORCE,
  Effect("encoder_offset", "l_knee", {"offset": 0.001}),
  Effect("encoder_offset", "r_knee", {"offset": 0.002}),
  Effect("backlash", "r_knee", {"gap": 0.01}),
  Effect("payload", "l_el_link", {"mass": 0.2}, {"mass": (0.1, 0.3)}),
  Effect("imu_bias", None, {"gyroscope_x": 0.01}),
]


def _row(kind, joint, body=None, **values):
  parameters = {name: {"value": value} for name, value in values.items()}
  return {"kind": kind, "joint": joint, "parameters": parameters} | ({"body": body} if body else {})


WEAK = _row("motor_gain", "l_knee", gain=0.16)
BIAS = _row("imu_bias", None, gyroscope_x=0.01)


def _content(verdict, *effects, in_reference=(BIAS,)):
  return {"verdict": verdict, "effects": list(effects), "in_reference": list(in_reference)}


def _places(effects):
  return [(effect.kind, effect.target) for effect in effects]


def test_names_enter_with_what_was_fitted_beside_them_at_their_joint_and_nothing_else():
  found = entering(MODEL, _content("partly", WEAK))
  assert _places(found) == [
    ("parameter_error", "l_knee"),
    ("motor_gain", "l_knee"),
    ("load_friction", "l_knee"),
    ("encoder_offset", "l_knee"),
    ("imu_bias", None),  # the reference shows it, too: the robot has it
  ]
  assert found[0].samples == {"gain": [0.97, 0.99]} and found[1].intervals == {"gain": (0.15, 0.17)}


def test_why_an_effect_enters_is_said():
  told = reasons(MODEL, _content("partly", WEAK))
  kept = {e.kind: why for e, why in zip(MODEL, told, strict=True) if why}
  assert kept == {
    "parameter_error": FITTED_BESIDE,
    "motor_gain": CLAIMED,
    "load_friction": FITTED_BESIDE,
    "encoder_offset": FITTED_BESIDE,
    "imu_bias": OWN,
  }


def test_a_load_enters_with_the_constants_of_the_joint_that_carries_it():
  model = [*MODEL, Effect("parameter_error", "l_el", {"gain": 0.95})]
  load = _row("payload", "l_el", "l_el_link", mass=0.2)
  found = entering(model, _content("effects", load, in_reference=()))
  assert _places(found) == [("payload", "l_el_link"), ("parameter_error", "l_el")]


def test_constants_that_are_off_alike_in_all_joints_enter_everywhere():
  found = entering(MODEL, _content("effects", _row("parameter_error", None), in_reference=()))
  assert _places(found)[:2] == [("parameter_error", "l_knee"), ("parameter_error", "r_knee")]
  assert not {"residual_force", "load_friction", "backlash"} & {effect.kind for effect in found}


@pytest.mark.parametrize("verdict", ["effects", "partly", "none"])
def test_a_learned_force_stays_out_where_names_explain(verdict):
  assert forces(MODEL, _content(verdict)) == []
  assert FORCE not in entering(MODEL, _content(verdict, WEAK))


def test_a_learned_force_enters_where_no_name_explains_with_what_was_fitted_beside_it():
  content = _content("unexplained", in_reference=())
  assert forces(MODEL, content) == [FORCE]
  assert {effect.target for effect in entering(MODEL, content)} == {"l_knee"}
  assert {"residual_force", "load_friction", "parameter_error"} <= {
    effect.kind for effect in entering(MODEL, content)
  }


def test_a_finding_keeps_what_enters_as_a_file_and_the_page_says_what_stays_out(tmp_path):
  content = _content("partly", WEAK) | {"notes": [], "seconds": 1.0}
  content["error"] = {"held": {"before": 0.02, "after": 0.007}, "floor": 0.0005}
  write_effects(tmp_path / "effects.json", MODEL)
  (tmp_path / "finding.json").write_text(json.dumps(content))
  before = naming.name(tmp_path, Path("no logs are read again"))
  assert before.entering_path.name == "effects.json"  # a loop that began with all of them
  assert len(before.entering) == len(MODEL)
  write_effects(tmp_path / "entering.json", entering(MODEL, content))
  named = naming.read(tmp_path)
  assert named.entering_path.name == "entering.json"
  assert _places(read_effects(named.entering_path)) == _places(named.entering)
  assert len(named.entering) == 5 and len(named.left_out) == len(MODEL) - 5
  assert "The 5 other effects of the analyser's extended model" in telling._entering(named)
  left_out = telling._left_out(named)
  assert left_out.startswith("parameter_error at r_knee; residual_force at l_knee; encoder_offset")
