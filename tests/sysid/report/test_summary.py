"""The report's four answers, of reports as they are written."""

import copy

import pytest

from nerf2real.sysid.report import summary

FRICTION = {
  "kind": "coulomb_friction",
  "joint": "knee",
  "parameters": {"torque": {"value": 0.25, "low": 0.24, "high": 0.26, "unit": "N m"}},
  "evidence": {"clear_by_standard_errors": 8.14},
}
NAMED = {
  "verdict": "effects",
  "effects": [FRICTION],
  "alternatives": [],
  "residual_at": {
    "joint": "knee",
    "log": "train_1.mcap",
    "velocity": {"low": -0.1, "high": 0.2, "share_of_square": 0.7},
  },
  "error": {
    "train": {"before": 0.02, "after": 0.002},
    "held": {"before": 0.03, "after": 0.0015},
    "floor": 0.001,
  },
  "next_excitation": {
    "design": "steps of 1.5 s",
    "centre_rad": 0.0,
    "amplitude_rad": 0.9,
    "separation_in_noise": 3.2,
    "separates": [["stribeck_friction"]],
    "would": "",
  },
}


def answers(content, unit="mrad"):
  (table,) = summary.section(content, beyond=3.0, unit=unit).blocks
  return [row[1] for row in table.rows]


@pytest.fixture
def content():
  return copy.deepcopy(NAMED)


def test_a_named_effect_has_its_value_its_certainty_and_what_remains(content):
  missing, sure, remains, record = answers(content)
  words = "coulomb_friction at knee (constant dry friction beyond the declared one)"
  assert missing == f"{words}: torque 0.25 N m (0.24 to 0.26)."
  assert "by 8.1 standard errors or more, where 3.0 are asked" in sure
  assert remains == ("1.5 mrad of 30 on logs that were not fitted, 1.5 times the readings' noise.")
  assert record.startswith("steps of 1.5 s, 0.9 rad about 0 rad: ")
  assert "of stribeck_friction, would differ by 3.2 times the noise" in record


def test_what_logs_do_not_tell_apart_is_said(content):
  rival = {"kind": "spring+viscous_friction", "kinds": [], "confounded": True}
  content["alternatives"] = [rival, {**rival, "kind": "backlash", "confounded": False}]
  _, sure, _, _ = answers(content)
  assert sure.startswith("Every other explanation")
  assert "These logs do not tell it from spring with viscous_friction." in sure


def test_of_many_effects_the_rest_is_counted(content):
  content["effects"] = [FRICTION] * 6
  assert answers(content)[0].endswith("; and 2 more, listed below.")


def test_without_held_logs_the_fitted_ones_are_said(content):
  content["error"]["held"] = None
  assert answers(content)[2].startswith("2 mrad of 20 on logs that were fitted, 2.0 times")


def test_an_extended_model_that_is_worse_is_said_to_be(content):
  content["error"]["held"]["after"] = 0.04
  assert answers(content)[2].endswith("worse than the declared one: do not use it.")


def test_nothing_and_no_name_are_different_answers(content):
  content["effects"] = []
  content["verdict"] = "none"
  missing, sure, remains, _ = answers(content)
  assert missing == "Nothing that these logs show."
  assert sure.startswith("No hypothesis") and "knee" not in remains
  content["verdict"] = "unexplained"
  content["alternatives"] = [FRICTION]
  missing, sure, remains, _ = answers(content)
  assert "at knee for which no name is clear. The nearest: coulomb_friction" in missing
  assert sure.startswith("Not sure")
  assert remains.endswith(
    "On the fitted logs most is at knee, in train_1.mcap, at -0.1 to 0.2 rad/s."
  )


def test_a_motion_without_a_reason_is_not_proposed(content):
  content["next_excitation"] |= {"separates": [], "separation_in_noise": 0.0}
  assert answers(content)[3] == "Nothing in particular."
  content["next_excitation"]["would"] = "show backlash"
  assert answers(content)[3] == "steps of 1.5 s, 0.9 rad about 0 rad: it would show backlash."


def test_rivals_that_no_motion_separates_are_said(content):
  content["next_excitation"]["separation_in_noise"] = 0.02
  words = "No motion that was tried tells the effect from stribeck_friction"
  assert answers(content)[3].startswith(words)


def test_rivals_with_equal_effects_are_said_once(content):
  content["next_excitation"] |= {"separation_in_noise": 0.02, "separates": [["spring"]] * 2}
  assert "from spring: they differ" in answers(content)[3]


def test_a_force_driven_joint_has_a_motion_in_words(content):
  content["next_excitation"] = {"design": "a longer log", "separates": [["payload"]], "would": ""}
  assert answers(content)[3] == "a longer log: it may tell the effect from payload."
