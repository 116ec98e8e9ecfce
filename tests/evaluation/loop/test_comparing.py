"""What was named beside what was hidden."""

import pytest

from nerf2real.evaluation.loop import comparing
from nerf2real.real.virtual import undeclared
from nerf2real.suite.effects import Effect


def _hidden(*texts):
  return undeclared.parse_all(texts)


def _found(kind, target=None, **values):
  """An effect whose values have intervals of 10 percent to both sides."""
  intervals = {n: (v - 0.1 * abs(v), v + 0.1 * abs(v)) for n, v in values.items()}
  return Effect(kind, target, values, intervals)


def test_the_right_name_at_the_right_place_with_its_interval():
  found = comparing.compare(_hidden("command_delay:0.045"), [_found("command_delay", delay=0.044)])
  (row,) = found.rows
  assert row.right and row.covered and not found.wrong
  assert row.named == "command_delay: delay 0.044 s (0.0396 to 0.0484)"


def test_an_interval_that_misses_is_told():
  found = comparing.compare(_hidden("command_delay:0.045"), [_found("command_delay", delay=0.03)])
  assert found.rows[0].right and found.rows[0].covered is False


def test_the_right_name_at_another_joint_is_wrong():
  found = comparing.compare(
    _hidden("motor_gain@l_knee:0.6"), [_found("motor_gain", "r_knee", gain=0.6)]
  )
  assert not found.rows[0].right and found.rows[0].named == ""
  assert found.wrong == ("motor_gain at r_knee: gain 0.6 (0.54 to 0.66)",)


def test_a_load_is_named_by_link_or_joint():
  for target in ("l_el", "l_el_link"):
    found = comparing.compare(
      _hidden("payload@l_el_link:0.25,0,0.07,0"), [_found("payload", target, mass=0.25)]
    )
    assert found.rows[0].right and found.rows[0].covered


def test_where_nothing_is_hidden_every_name_is_wrong_and_constants_are_none():
  effects = [_found("parameter_error", "l_knee", gain=1.1), _found("residual_force", "l_knee")]
  assert comparing.compare((), effects) == comparing.Comparison((), ())
  found = comparing.compare((), [*effects, _found("camera_latency", delay=0.02)])
  assert len(found.wrong) == 1 and found.wrong[0].startswith("camera_latency")


def test_what_the_library_lacks_has_no_right_name():
  hidden = _hidden("rest_friction:0.3,0.3")
  assert comparing.compare(hidden, []).rows[0].right
  accused = comparing.compare(hidden, [_found("stribeck_friction", "l_knee", breakaway=0.2)])
  assert accused.wrong and accused.rows[0].named == ""


@pytest.mark.parametrize("kind", ["supply_sag", "motor_gain"])
def test_a_sagging_supply_may_be_described_as_weakness(kind):
  effect = Effect(kind, None, {"gain": 0.8} if kind == "motor_gain" else {"fade": 1e-4})
  found = comparing.compare(_hidden("sagging_supply"), [effect])
  assert found.rows[0].right and found.rows[0].named and found.rows[0].covered is None


def test_what_the_robot_had_before_is_no_wrong_name():
  own = [_found("load_friction", "l_knee", coefficient=0.2), _found("imu_bias", gyroscope_x=0.02)]
  late = _found("command_delay", delay=0.044)
  found = comparing.compare(_hidden("command_delay:0.045"), [late], own)
  assert found.rows[0].right and not found.wrong
  assert [text.split(":")[0] for text in found.in_reference] == [
    "load_friction at l_knee",
    "imu_bias",
  ]


def test_a_tilt_of_a_robot_that_is_held_describes_the_floor_s_slope():
  found = comparing.compare(_hidden("floor_slope:0,0.04"), [_found("gravity_tilt", x=0.0, y=0.04)])
  assert found.rows[0].right and not found.wrong
