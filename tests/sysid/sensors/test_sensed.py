"""What a sensor shows beside what it showed in a reference."""

import dataclasses

from nerf2real.sysid.sensors.sensed import Estimate, Part, row


def _part(value, half, *, usual=0.0, named=True):
  values = {"gyroscope_x": (value, value - half, value + half)}
  rows = [row("imu_bias", "gyro", values, 1.0, 1.0)] if named else []
  estimate = Estimate(value, value - half, value + half, usual)
  return Part(rows, estimates={("imu_bias", "gyroscope_x"): estimate})


def test_a_bias_that_was_there_before_is_no_change_and_stays_in_the_model():
  part = _part(0.020, 0.001).beside(_part(0.0205, 0.001))
  assert part.rows == []
  assert [r["kind"] for r in part.in_reference] == ["imu_bias"]
  assert [e.kind for e in part.effects] == ["imu_bias"]


def test_a_bias_that_grew_is_named():
  part = _part(0.020, 0.001).beside(_part(0.010, 0.001))
  assert [r["kind"] for r in part.rows] == ["imu_bias"] and part.in_reference == []


def test_what_was_too_small_to_be_named_before_is_compared_all_the_same():
  before = _part(0.0195, 0.001, named=False)
  assert _part(0.020, 0.001).beside(before).rows == []
  assert _part(0.020, 0.001).beside(dataclasses.replace(before, estimates={})).rows != []


def test_a_change_counts_from_what_sensors_of_one_kind_differ_by():
  assert _part(0.020, 0.001).beside(_part(0.016, 0.001, usual=0.005)).rows == []
