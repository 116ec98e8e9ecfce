"""Where nothing presses teeth together two recordings differ by where in the gap a joint lay."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.hypotheses.constants import own_size
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.selection.joints import leaving, play, subject
from nerf2real.sysid.selection.joints.subject import Subject
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.synthetic import COUNT, PENDULUM, logs_of

GAP = 3e-3  # rad, of a healthy gear
# About the vertical, its mass beside the axis: gravity does not turn it.
TURNTABLE = PENDULUM.replace('axis="0 1 0"', 'axis="0 0 1"').replace("0 0 -0.15", "0.15 0 0")
LEVEL = PENDULUM.replace("0 0 -0.15", "0.15 0 0")
_SEGMENT = 0.3  # s for which a joint lies at one place in its gap


def _lying_anywhere(log: Log, gap: float, random: np.random.Generator) -> Log:
  """A log whose joint lies now here, now there in a gap."""
  segment = (log.states.stamp / _SEGMENT).astype(int)
  place = gap * (random.random(segment[-1] + 1) - 0.5)
  position = np.round((log.states.position + place[segment, None]) / COUNT) * COUNT
  return dataclasses.replace(log, states=dataclasses.replace(log.states, position=position))


def _prepared(xml: str, gap: float, known: float) -> Subject:
  """A joint whose logs lie in one gap and whose reference lay in another."""
  model, random = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(0)
  logs, before = ([_lying_anywhere(log, g, random) for log in logs_of(xml)] for g in (gap, known))
  machines = Machine(model, logs), Machine(model, before)
  found = subject.prepare("joint", *machines, tried=1, settings=SETTINGS)
  assert found.paired
  return found


@pytest.mark.parametrize(
  ("xml", "gap", "known", "more"),
  [
    (TURNTABLE, GAP, GAP, False),
    (TURNTABLE, GAP, 0.0, True),  # where its reference shows no play there was none
    (TURNTABLE, 6 * GAP, 6 * GAP, True),  # more than healthy gears have
    (LEVEL, GAP, GAP, True),  # gravity holds it at one side of the gap
  ],
)
def test_a_joint_lies_anywhere_in_a_healthy_gap_where_nothing_presses_it(xml, gap, known, more):
  found = _prepared(xml, gap, known)
  assert leaving.leaves(found, found.explainer.null, SETTINGS) == more


def test_what_play_may_move_is_bounded_by_the_gap_and_by_the_reference():
  found = _prepared(TURNTABLE, GAP, GAP)
  squares, most = (
    play.beside(found.now, found.explainer.null),
    own_size(found.now.plant, "backlash", "gap"),
  )
  assert np.all(squares <= 2.0 * most**2 / 12.0)
  assert np.median(squares) > GAP**2 / 12.0  # half of what two places in it differ by
  pressed = _prepared(LEVEL, GAP, GAP)
  assert np.median(play.beside(pressed.now, pressed.explainer.null)) == 0.0
