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
  "in_reference": [],
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


SHOWN = "Of 19 kinds of effect these logs would not show cogging."


def answers(content, unit="mrad", referred=False):
  """Returns the four answers, each with its details, and their tones."""
  part = summary.section(content, asked=(3.0, 4.0), unit=unit, shown=SHOWN, referred=referred)
  (block,) = part.blocks
  return [" | ".join((a.answer, *a.details)) for a in block.answers]


def tones(content):
  (block,) = summary.section(
    content, asked=(3.0, 4.0), unit="mrad", shown=SHOWN, referred=False
  ).blocks
  return [answer.tone for answer in block.answers]


@pytest.fixture
def content():
  return copy.deepcopy(NAMED)


def test_of_several_the_least_certain_is_told_with_what_is_asked_of_it(content):
  """A joint's second effect must be clear by more than its first."""
  first = content["effects"][0]

  def effect(joint, clear, **evidence):
    return {**first, "joint": joint, "evidence": {"clear_by_standard_errors": clear, **evidence}}

  content["effects"] = [effect("knee", 9.0), effect("knee", 4.3), effect("hip", 3.7)]
  assert answers(content)[1].startswith("4.3 standard errors, for the least certain; 4.0 are asked")
  content["effects"] = [effect("knee", 9.0), effect("knee", 8.0), effect("hip", 3.2)]
  assert answers(content)[1].startswith("3.2 standard errors, for the least certain; 3.0 are asked")
  content["effects"] = [effect("knee", 9.0), effect("knee", 3.5, servo_law=True)]
  assert answers(content)[1].startswith("3.5 standard errors, for the least certain; 3.0 are asked")


def test_a_named_effect_has_its_value_its_certainty_and_what_remains(content):
  missing, sure, remains, record = answers(content)
  words = "Coulomb friction at knee | Constant dry friction beyond the declared one;"
  assert missing == f"{words} torque 0.25 N m (0.24 to 0.26). | In brackets: 95 % intervals."
  assert sure.startswith("8.1 standard errors; 3.0 are asked | By so much every explanation")
  assert remains.startswith("1.5 mrad, 1.5 times the readings' noise | The declared model leaves")
  assert record.startswith("Steps of 1.5 s, 0.9 rad about 0 rad | ")
  assert "of stribeck friction, would differ by 3.2 times the noise" in record
  (block,) = summary.section(
    content, asked=(3.0, 4.0), unit="mrad", shown="", referred=False
  ).blocks
  assert block.answers[2].bars == {
    "declared, 30 mrad": 0.03,
    "extended, 1.5 mrad": 0.0015,
    "noise of the readings, 1 mrad": 0.001,
  }
  assert "warn" not in tones(content)


def test_what_logs_do_not_tell_apart_is_said(content):
  rival = {"kind": "spring+viscous_friction", "kinds": [], "confounded": True}
  content["alternatives"] = [rival, {**rival, "kind": "backlash", "confounded": False}]
  _, sure, _, _ = answers(content)
  assert "By so much every other explanation" in sure
  assert sure.endswith("These logs do not tell it from spring + viscous friction.")
  assert tones(content)[1] == "warn"


def test_what_logs_do_not_tell_apart_at_several_joints_is_listed_by_joint(content):
  rival = {"kinds": [], "confounded": True}
  content["alternatives"] = [
    {**rival, "joint": joint, "kind": kind}
    for joint in ("knee", "hip")
    for kind in ("spring+viscous_friction", "payload")
  ]
  _, sure, _, _ = answers(content)
  assert sure.endswith("At knee, hip other explanations are as good: they are listed below.")
  kinds = ["spring+viscous_friction", "payload"]
  assert summary.alike_by_place(content["alternatives"]) == {"knee": kinds, "hip": kinds}


def test_of_many_effects_the_rest_is_counted(content):
  content["effects"] = [FRICTION] * 6
  missing = answers(content)[0]
  assert ", and 2 more, listed below | Coulomb friction at knee: constant dry" in missing


def test_names_that_are_not_all_are_said_not_to_be(content):
  content["verdict"] = "partly"
  assert answers(content)[0].startswith("Coulomb friction at knee; and something that has no clear")
  assert [tone == "warn" for tone in tones(content)] == [True, False, True, False]


def test_without_held_logs_the_fitted_ones_are_said(content):
  content["error"]["held"] = None
  remains = answers(content)[2]
  assert remains.startswith("2 mrad, 2.0 times") and remains.endswith("which were fitted.")


def test_readings_without_noise_are_no_measure(content):
  content["error"]["floor"] = 1e-9
  assert answers(content)[2].startswith("1.5 mrad, over 1000 times the readings' noise")


def test_an_extended_model_that_is_worse_is_said_to_be(content):
  content["error"]["held"]["after"] = 0.04
  assert answers(content)[2].endswith("worse than the declared one: do not use it.")
  assert tones(content)[2] == "warn"


def test_nothing_and_no_name_are_different_answers(content):
  content["effects"] = []
  content["verdict"] = "none"
  missing, sure, remains, _ = answers(content)
  assert missing == "Nothing that these logs show"
  assert sure == f"No effect is clearly better than none | {SHOWN}"
  assert "knee" not in remains
  assert "What lowers it: its constants, fitted within their tolerances." in remains
  content["verdict"] = "unexplained"
  constants = {**FRICTION, "kind": "parameter_error"}
  content["alternatives"] = [constants, FRICTION]
  missing, sure, remains, _ = answers(content)
  assert missing.startswith("Something at knee that has no clear name | The nearest, which is not")
  assert "claimed: coulomb friction at knee: constant" in missing
  assert sure.startswith("Not sure")
  assert remains.endswith(
    "On the fitted logs most is at knee, in train_1.mcap, at -0.1 to 0.2 rad/s."
  )


def test_a_large_remainder_is_not_called_nothing(content):
  content |= {"effects": [], "verdict": "none"}
  content["error"]["held"] = {"before": 0.113, "after": 0.113}
  missing = answers(content)[0]
  assert missing.startswith("Nothing that has a name, yet the model does not fit | The model mov")
  assert tones(content)[0] == "warn"
  assert answers(content, referred=True)[0] == "Nothing has changed since the reference"
  content["error"]["held"]["after"] = 0.05  # as healthy machines leave whose physics it lacks
  assert answers(content)[0] == "Nothing that these logs show"


def test_what_gains_nothing_is_not_the_nearest(content):
  content |= {"effects": [], "verdict": "unexplained"}
  content["alternatives"] = [{**FRICTION, "evidence": {"held_out_gain_nats": 0.0}}]
  missing = answers(content)[0]
  assert missing.endswith(
    "that has no clear name | No effect that was tried predicts parts of the"
    " logs better that were left out."
  )
  content["alternatives"] += [{**FRICTION, "kind": "backlash"}]
  content["alternatives"][1]["evidence"] = {"held_out_gain_nats": 0.2}
  assert "The nearest, which is not claimed: backlash at knee" in answers(content)[0]


def test_nothing_new_beside_a_reference_is_not_said_to_be_a_model_that_lacks_nothing(content):
  content |= {"effects": [], "verdict": "none", "in_reference": [FRICTION]}
  missing, _, remains, _ = answers(content, referred=True)
  assert missing.startswith("Nothing has changed since the reference | In the reference, too: coul")
  assert "What lowers it: what the reference shows, too, and its constants" in remains


def test_a_motion_without_a_reason_is_not_proposed(content):
  content["next_excitation"] |= {"separates": [], "separation_in_noise": 0.0}
  assert answers(content)[3] == "Nothing in particular"
  content["next_excitation"]["would"] = "show backlash"
  assert answers(content)[3] == "Steps of 1.5 s, 0.9 rad about 0 rad | It would show backlash."


def test_rivals_that_no_motion_separates_are_said(content):
  content["next_excitation"]["separation_in_noise"] = 0.02
  words = "No motion that was tried would tell more | Stribeck friction would differ from what is"
  assert answers(content)[3].startswith(words)
  content |= {"effects": [], "verdict": "none"}
  assert answers(content)[3] == "Nothing in particular"


def test_a_rival_that_adds_to_what_is_named_is_said_so(content):
  sets = [["coulomb_friction", "spring"], ["backlash", "spring"]]
  content["next_excitation"] |= {"joint": "knee", "separates": sets}
  assert "of the same + spring or backlash + spring, would differ" in answers(content)[3]


def test_rivals_with_equal_effects_are_said_once(content):
  content["next_excitation"] |= {"separation_in_noise": 0.02, "separates": [["spring"]] * 2}
  assert "Spring would differ" in answers(content)[3]


def test_a_force_driven_joint_has_a_motion_in_words(content):
  content["next_excitation"] = {"design": "a longer log", "separates": [["payload"]], "would": ""}
  assert answers(content)[3] == "A longer log | It may tell what is found from payload."
