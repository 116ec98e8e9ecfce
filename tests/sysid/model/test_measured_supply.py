"""A supply's sag is bounded by its measured voltage."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import ScalarSeries
from nerf2real.sysid.hypotheses.candidates import library
from nerf2real.sysid.model.joint import JointModel
from tests.sysid.synthetic import PENDULUM, log_of


def _supplies(voltage):
  """The forms of a supply's sag that are searched for, and what they are without a voltage."""
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  logs = [log_of(PENDULUM, kind) for kind in ("sweep", "steps")]
  plain = JointModel(model, "joint", logs)
  torque, read = plain.declared_torque(), []
  for log in logs:  # every tenth reading of the motion has one of the voltage
    stamp = log.states.stamp
    load, torque = torque[: len(stamp)], torque[len(stamp) :]
    series = ScalarSeries(stamp[::10], stamp[::10], voltage(stamp, load)[::10])
    read.append(dataclasses.replace(log, battery=series))
  found = [library(plant) for plant in (JointModel(model, "joint", read), plain)]
  return tuple([t for t in terms if t.kind == "supply_sag"] for terms in found)


def test_a_steady_voltage_leaves_no_sag():
  noise = np.random.default_rng(0)
  bounded, before = _supplies(lambda time, load: 12.0 + 0.2 * noise.standard_normal(len(time)))
  assert len(bounded) == len(before) > 1
  for term, was in zip(bounded, before, strict=True):
    assert term.high[0] < 0.1 * was.high[0] and term.high[1] < 0.1 * was.high[1]
    assert all(np.all(np.array(start) <= term.high) for start in term.starts)


@pytest.mark.parametrize(("droop", "fade"), [(0.02, 0.0), (0.0, 0.01)])
def test_what_the_voltage_fell_by_stays_open(droop, fade):
  bounded, _ = _supplies(lambda time, load: 12.0 * (1.0 - droop * load - fade * time))
  by_torque = [t for t in bounded if not dict(t.fixed)["back_emf"]]
  assert by_torque
  for term in by_torque:
    assert droop <= term.high[0] and fade <= term.high[1]
    told = term.high[0] if droop else term.high[1]
    assert told < 10 * (droop or fade)
