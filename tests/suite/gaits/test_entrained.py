"""The gait whose phase is read from the control signals: what it reads, what it leads to."""

import numpy as np
import pytest

from nerf2real.suite.gaits import legs, walk
from nerf2real.suite.gaits.entrained import HISTORY, EntrainedGait
from nerf2real.suite.op3 import constants

LEGS = legs.COLUMNS.ravel()
WALK = walk.Command(forward=1.0)
STRENGTH = constants.ACTION_FILTER


def _clocked(command, steps=100):
  """Marches the gait with a clock; returns its control signals [N, 20] and phases [N]."""
  gait, controls, phases = walk.Gait(), [], []
  for _ in range(steps):
    gait.act(command)
    controls.append(gait.control)
    phases.append(gait.phase)
  return np.array(controls), np.array(phases)


def _drive(gait, command, steps, *, share=1.0, stand=None, control=None):
  """Applies a share of the gait's actions, the rest to stand; returns actions and controls."""
  control = gait.control if control is None else control
  actions, controls = [], []
  for _ in range(steps):
    action = np.asarray(gait.act(command), np.float64)
    if share < 1.0:
      action = share * action + (1 - share) * (stand - STRENGTH * control) / (1 - STRENGTH)
    control = STRENGTH * control + (1 - STRENGTH) * action
    gait.follow(control)
    actions.append(action)
    controls.append(control)
  return np.array(actions), np.array(controls)


@pytest.fixture(scope="module")
def stand():
  return _clocked(walk.Command(step=False))[0][-1]


@pytest.mark.parametrize("forward", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("turn", [-1.0, -0.3, 0.0, 0.7])
def test_the_phase_of_a_clocked_gait_is_read_from_its_controls(forward, turn):
  controls, phases = _clocked(walk.Command(forward, turn))
  gait = EntrainedGait()
  found = np.array(
    [gait.oscillation(controls[i - HISTORY + 1 : i + 1]) for i in range(60, len(controls))]
  )
  errors = np.angle(found * np.exp(-1j * phases[60:]))
  step = 2 * np.pi * constants.CONTROL_TIMESTEP / walk.GaitSettings().period
  assert np.abs(errors).max() < 0.5 * step and np.sqrt(np.mean(errors**2)) < 0.2 * step
  assert np.abs(found).min() > 0.8 and np.abs(found).max() < 1.2


def test_what_it_does_is_a_function_of_the_last_controls(stand):
  controls, _ = _clocked(WALK)
  walked, stood = EntrainedGait(), EntrainedGait()
  _drive(walked, WALK, 53)
  _drive(stood, WALK, 80, share=0.0, stand=stand)
  for gait in (walked, stood):
    for control in controls[-HISTORY:]:
      gait.follow(control)
  assert walked.phase == stood.phase
  assert walked.act(WALK) == pytest.approx(stood.act(WALK), abs=1e-6)


def test_a_robot_that_stands_is_started_by_one_action(stand):
  gait, rng, actions = EntrainedGait(), np.random.default_rng(0), []
  _drive(gait, WALK, 50)
  for _ in range(60):
    gait.follow(stand + 0.003 * rng.standard_normal(20))
    actions.append(gait.act(WALK)[LEGS])
  actions = np.array(actions[HISTORY:])
  assert actions.std(axis=0).mean() < 0.1 < 0.3 < np.abs(actions.mean(axis=0) - stand[LEGS]).mean()


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_robot_that_does_a_part_of_it_oscillates_and_then_steps(stand, share):
  gait = EntrainedGait()
  _, controls = _drive(gait, walk.Command(step=False), 60)
  phases = []
  for _ in range(80):
    _, controls = _drive(gait, WALK, 1, share=share, stand=stand, control=controls[-1])
    phases.append(gait.phase)
  turns = np.diff(np.unwrap(phases))[20:] / (2 * np.pi)
  assert turns.min() > 0
  assert np.mean(turns) == pytest.approx(0.025 / gait.settings.period, rel=0.2)
  _, controls = _drive(gait, WALK, 40, control=controls[-1])
  assert abs(gait.oscillation(controls[-HISTORY:])) > 0.8


def test_it_comes_to_a_stand_when_told(stand):
  gait = EntrainedGait()
  _drive(gait, WALK, 60)
  _, controls = _drive(gait, walk.Command(step=False), 60)
  assert np.abs(controls[-1] - stand)[LEGS].max() < 0.01


def test_it_takes_its_posture_in_twice_the_time_of_a_clocked_gait(stand):
  step = constants.CONTROL_TIMESTEP
  reached = []
  for kind in (walk.Gait, EntrainedGait):
    gait, count = kind(), 0
    start = gait.control[LEGS].copy()
    while np.abs(gait.control[LEGS] - stand[LEGS]).max() > 0.1 * np.abs(start - stand[LEGS]).max():
      gait.act(walk.Command(step=False))
      gait.follow(gait.control)
      count += 1
    reached.append(count * step)
  assert reached[1] == pytest.approx(2 * reached[0], rel=0.2)
