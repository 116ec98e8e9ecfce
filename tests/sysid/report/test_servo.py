"""A servo's gain by its duty, as entries of a report and of effects.json, and later."""

import types

import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.drift.values import compare
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.report import servo
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.model.servo.test_law import plant_of


def found_of(*, reference: bool, **law):
  """Returns what an identification of a joint found, as far as the servo's law is concerned."""
  plant = plant_of(noise=0.001, **law)
  likelihood = types.SimpleNamespace(law=plant.law[0], plant=plant, floor=[1e-3, 1e-3])
  before = likelihood if reference else None
  item = types.SimpleNamespace(
    joint="joint",
    likelihood=likelihood,
    known=(constants(plant),),
    subject=types.SimpleNamespace(before=before),
  )
  return types.SimpleNamespace(joints=[item])


def test_a_gain_that_is_off_is_claimed_with_the_interval_of_the_duty():
  claimed, before = servo.rows(found_of(reference=False, gain=0.5))
  assert before == []
  (row,) = claimed
  assert (row["kind"], row["joint"]) == ("motor_gain", "joint")
  gain = row["parameters"]["gain"]
  assert gain["low"] < 0.5 < gain["high"] < 0.51
  assert row["evidence"]["clear_by_standard_errors"] > 20.0
  assert servo.by_law(row) and not servo.by_law({"evidence": {}})


def test_what_the_reference_shows_is_not_new_and_a_healthy_gain_is_nothing():
  claimed, before = servo.rows(found_of(reference=True, gain=0.5))
  assert claimed == [] and len(before) == 1
  assert servo.rows(found_of(reference=False, gain=1.01)) == ([], [])


def test_laws_of_many_joints_are_one_sentence_and_a_dead_band_its_own():
  one, other = found_of(reference=False, gain=0.9), found_of(reference=False, gain=1.1)
  wide = found_of(reference=False, band=0.012)
  (note,) = servo.notes(one)
  assert note.startswith("The duty of joint against")
  together, own = servo.notes(
    types.SimpleNamespace(joints=[*one.joints * 3, *other.joints, *wide.joints])
  )
  assert together.startswith("The duty of 4 joints") and "0.900 to 1.100" in together
  assert "dead band" in own


def test_the_file_holds_the_gain_apart_from_the_torque_at_a_duty():
  claimed, _ = servo.rows(found_of(reference=False, gain=0.5))
  value = claimed[0]["parameters"]["gain"]["value"]
  constant = Effect(
    "parameter_error",
    "joint",
    {"gain": 1.02 * value, "limit": 1.02},
    {"gain": (0.99 * value, 1.05 * value), "limit": (0.99, 1.05)},
    {"gain": [value, 1.1 * value]},
  )
  corrected, gain = servo.apart([constant], claimed)
  assert corrected.parameters == {"gain": pytest.approx(1.02), "limit": 1.02}
  assert corrected.intervals["gain"] == pytest.approx(corrected.intervals["limit"])
  assert corrected.samples["gain"] == pytest.approx([1.0, 1.1])
  assert (gain.kind, gain.parameters["gain"]) == ("motor_gain", value)


@pytest.mark.parametrize("place", ["joint", None])
def test_a_motor_that_is_weak_besides_keeps_one_effect_and_the_product(place):
  claimed, _ = servo.rows(found_of(reference=False, gain=0.5))
  constant = Effect("parameter_error", "joint", {"gain": 0.51, "limit": 1.02})
  weak = Effect("motor_gain", place, {"gain": 0.4, "scales_limit": 1.0})
  assert servo.apart([constant, weak], claimed) == [constant, weak]


def test_the_law_is_said_in_a_sentence():
  (sentence,) = servo.notes(found_of(reference=False, gain=0.5, delay=0.03, top=0.6))
  assert sentence.startswith("The duty of joint against its position error: 0.50")
  assert "60 % of full duty at most" in sentence


def test_a_later_gain_is_compared_by_its_duty_alone():
  claimed, _ = servo.rows(found_of(reference=False, gain=0.5))
  stored = types.SimpleNamespace(content={"effects": claimed}, joints=[])
  for gain, verdict in ((0.5, "fits"), (0.6, "moved")):
    now = {"joint": found_of(reference=False, gain=gain).joints[0].likelihood}
    (value,), skipped = compare(stored, now, level=0.05, settings=SETTINGS)
    assert skipped == ()
    assert value.state == verdict
