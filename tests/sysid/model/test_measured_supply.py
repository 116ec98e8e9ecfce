"""A supply's sag is bounded by its measured voltage."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import ScalarSeries
from nerf2real.core.robot_logs.series import JointSeries
from nerf2real.suite.effects import Effect
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
  assert by_torque and (not droop or bounded == by_torque)
  for term in by_torque:
    assert droop <= term.high[0] and fade <= term.high[1]
    told = term.high[0] if droop else term.high[1]
    assert told < 10 * (droop or fade)


@pytest.mark.parametrize("late", [0.0, 0.014])
@pytest.mark.parametrize("logs_duty", [False, True])
def test_the_voltage_tells_what_draws_on_the_supply(logs_duty, late):
  """Of a supply that falls with the motor's current, read later than the motion that draws it."""
  droop, values = 0.03, {"scales_limit": 1.0, "back_emf": 1.0, "pulsed": 1.0}
  effect = Effect("supply_sag", None, {"droop": droop, **values})
  model, logs = mujoco.MjModel.from_xml_string(PENDULUM), []
  for kind in ("sweep", "steps"):
    log = log_of(PENDULUM, kind, [effect], rounding=0.0)
    stamp, commands = log.states.stamp, log.commands
    place = log.states.position[:, 0]
    speed = np.gradient(place, stamp)
    given = commands.position[np.searchsorted(commands.stamp, stamp, side="right") - 1, 0]
    full = np.clip(21 * (given - place), -4.0, 4.0)
    volt = 12.0 * (1 + droop * np.sign(full) * speed) / (1 + droop * np.abs(full))
    read = ScalarSeries(stamp[5::10] + late, stamp[5::10] + late, volt[5::10])
    duty = (
      JointSeries(("joint",), stamp, stamp, None, None, full[:, None] / 4) if logs_duty else None
    )
    logs.append(dataclasses.replace(log, battery=read, pwm=duty))
  terms = [t for t in library(JointModel(model, "joint", logs)) if t.kind == "supply_sag"]
  assert terms and all(dict(t.fixed)["pulsed"] for t in terms)
  for term in terms:
    assert term.starts[0][0] == pytest.approx(droop, rel=0.1)
    assert droop < term.high[0] < 3 * droop
