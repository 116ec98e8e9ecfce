"""Sentences of a report that follow from what was found."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.series import JointSeries
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.outputs.notes import (
  another_session,
  far,
  growing,
  long_step,
  open_loads,
  supply,
  unmeasured,
)
from tests.sysid.synthetic import ARM, log_of


@pytest.mark.parametrize(
  ("paired", "apart", "said"), [(True, True, 1), (True, False, 0), (False, True, 0)]
)
def test_a_reference_of_another_session_is_said(paired, apart, said):
  """Where the same motions are compared; other ones are judged by their own scatter."""
  subject = SimpleNamespace(paired=paired, another_session=apart)
  notes = another_session(SimpleNamespace(joint="knee", subject=subject))  # type: ignore[arg-type]
  assert len(notes) == said
  assert all("reference of knee" in note and "friction by 15 %" in note for note in notes)


def test_what_changes_within_a_log_is_said_with_its_joint():
  found = [SimpleNamespace(joint=j, growing=g) for j, g in (("knee", ()), ("hip", ("spring",)))]
  (note,) = growing(found)  # type: ignore[arg-type]
  assert "spring at hip" in note and "knee" not in note
  assert growing(found[:1]) == []  # type: ignore[arg-type]


def test_a_load_whose_mass_may_be_nothing_is_said_to_be_open():
  def load(body, low):
    return {"kind": "payload", "body": body, "parameters": {"mass": {"low": low}}}

  other = {"kind": "spring", "parameters": {"stiffness": {"low": 0.0}}}
  (note,) = open_loads([load("hand", 0.0), load("foot", 0.1), other])
  assert "hand" in note and "foot" not in note
  assert open_loads([load("foot", 0.1), other]) == []


def test_a_step_that_is_long_for_a_joints_damping_is_said():
  declared = np.zeros(len(INDEX))
  declared[INDEX["armature"]] = 0.04
  around = [SimpleNamespace(inertia=np.array([0.05, 0.07]))]
  plants = [
    SimpleNamespace(declared=declared, surroundings=around, numerical_inertia=added, step=0.002)
    for added in (0.001, 0.015)
  ]
  found = [
    SimpleNamespace(joint=name, verdict="effects", likelihood=SimpleNamespace(plant=plant))
    for name, plant in zip(("elbow", "wrist"), plants, strict=True)
  ]
  (said,) = long_step(found)  # type: ignore[arg-type]
  assert "step of 2 ms is long for the damping at wrist: that acts as inertia" in said
  assert "up to 0.15 times its own, and as 1 ms of lag" in said
  assert not long_step(found[:1])  # type: ignore[arg-type]
  found[1].verdict = "none"
  assert not long_step(found)  # type: ignore[arg-type]


def test_joints_that_no_log_has_are_said():
  others = (
    '<body><joint name="door"/><geom size="1"/></body><body><freejoint/><geom size="1"/></body>'
  )
  model = mujoco.MjModel.from_xml_string(ARM.replace("</worldbody>", f"{others}</worldbody>"))
  log = log_of(ARM, "slow", duration=1.5)
  assert not unmeasured(model, [log])

  def alone(series):
    return JointSeries(
      ("shoulder",), series.stamp, series.stamp, series.position[:, :1], None, None
    )

  log = dataclasses.replace(log, states=alone(log.states), commands=alone(log.commands))
  (said,) = unmeasured(model, [log])
  assert "in no log, and so held where the model declares them: elbow. If they move" in said
  assert said.endswith(
    "record their positions, or give a model in which they are fixed, if they are."
  )


def test_a_remainder_far_above_the_noise_is_said():
  error = {"train": {"after": 0.001}, "held": {"after": 0.113}, "floor": 0.000329}
  (said,) = far(error)
  assert said.startswith("What remains is 343 times the readings' noise")
  assert not far({**error, "held": None})


def _logs(*volts):
  values = [None if v is None else SimpleNamespace(value=np.array([v, v, v - 1.0])) for v in volts]
  return [SimpleNamespace(battery=value) for value in values]


def test_another_voltage_than_the_reference_s_is_said():
  (said,) = supply(_logs(11.2, 11.4), _logs(12.0))
  assert "11.2 V in the median, 12.0 V in the reference (93 %)" in said
  assert not supply(_logs(12.0), _logs(12.1))  # machines' strength differs by as much
  assert not supply(_logs(11.2, None), _logs(12.0))
  assert not supply(_logs(11.2), _logs(None)) and not supply(_logs(11.2), [])
