"""Joints that are commanded and do not move are not judged."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import LogError, check_motion, moves
from nerf2real.sysid.design import identifiability
from nerf2real.sysid.fit import resolution
from nerf2real.sysid.fit.noise import timing
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.measured import fresh
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.outputs import notes
from nerf2real.sysid.selection import analysis
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import ARM, COUNT, PENDULUM, log_of

MODEL = mujoco.MjModel.from_xml_string(ARM)


def _frozen(log, *joints):
  position = log.states.position.copy()
  for joint in joints:
    position[:, log.states.column(joint)] = 0.3
  return dataclasses.replace(log, states=dataclasses.replace(log.states, position=position))


@pytest.mark.parametrize("place", [0.0, 0.3])
def test_equal_readings_of_a_joint_at_rest_are_no_repeats(place):
  time = np.arange(0.0, 1.0, 0.01)
  assert fresh(time, np.full(100, place), np.full(100, 1e-15)).all()


def test_a_log_without_motion_does_not_make_the_readings_exact():
  logs = [log_of(PENDULUM, "sweep", duration=3.0), _frozen(log_of(PENDULUM, "slow"), "joint")]
  noise, _ = timing(JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs))
  assert noise > 0.2 * COUNT


@pytest.mark.parametrize("where", ["logs", "reference"])
def test_a_joint_that_does_not_move_is_noted_and_not_judged(where, monkeypatch):
  log, judged = log_of(ARM, "sweep", duration=3.0), []
  parts = {"logs": [log], "reference": [log]} | {where: [_frozen(log, "elbow")]}
  monkeypatch.setattr(analysis, "prepare", lambda joint, *_, **__: judged.append(joint))
  monkeypatch.setattr(analysis, "_explained", lambda *_: ([], []))
  told: list[tuple[float, str]] = []
  reports = lambda *report: told.append(report)  # noqa: E731
  found = analysis.analyse(MODEL, parts["logs"], parts["reference"], progress=reports)
  assert judged == ["shoulder"] and found.still == ["elbow"]
  assert told == [(0.0, "constants of shoulder, 1 of 1 joints")]
  (note,) = notes.still(found.still)
  assert "elbow" in note and not notes.still([])


def test_what_a_joint_that_does_not_move_can_show_is_not_asked(monkeypatch):
  log = _frozen(log_of(ARM, "sweep", duration=3.0), "elbow")
  monkeypatch.setattr(identifiability, "identifiability", lambda joint, _: joint.plant.joint)
  shown = identifiability.of_machine(Machine(MODEL, [log]), repeated=False, settings=SETTINGS)
  assert shown == ["shoulder"]


def test_logs_in_which_nothing_moves_are_refused():
  log = log_of(ARM, "sweep", duration=2.0)
  check_motion([_frozen(log, "elbow")])
  assert moves([log], "elbow") and not moves([_frozen(log, "elbow")], "elbow")
  with pytest.raises(LogError, match="no commanded joint that moves"):
    check_motion([_frozen(log, "elbow", "shoulder")])


def test_a_joint_that_does_not_move_asks_for_no_finer_step():
  model = mujoco.MjModel.from_xml_string(ARM.replace('timestep="0.001"', 'timestep="0.002"'))
  logs = [_frozen(log_of(ARM, "sweep", duration=4.0), "elbow")]
  assert resolution.numerics(Machine(model, logs)) == Numerics(0.002)
