"""A supply's sag is bounded by its measured voltage."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.sysid.hypotheses.candidates import library
from nerf2real.sysid.hypotheses.measured_supply import _asked_torque
from nerf2real.sysid.model.joint import JointModel
from tests.sysid.synthetic import PENDULUM, log_of


def _supplies(voltage):
  """The forms of a supply's sag that are searched for, beside what they are without a voltage."""
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  plant = JointModel(model, "joint", [log_of(PENDULUM, kind) for kind in ("sweep", "steps")])
  open_ones = [t for t in library(plant) if t.kind == "supply_sag"]
  torque = np.abs(_asked_torque(plant))
  first = len(plant.logs[0].time)
  loads = torque[:first], torque[first:]
  plant.logs = [
    dataclasses.replace(log, voltage=voltage(log.time, load))
    for log, load in zip(plant.logs, loads, strict=True)
  ]
  return [t for t in library(plant) if t.kind == "supply_sag"], open_ones


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
