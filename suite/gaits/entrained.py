"""A gait whose phase and amplitude are functions of the last control signals, in place of a clock.

A clock that runs on while the robot stands cannot be inferred from anything that a policy observes:
the mean of such a gait's actions over all phases is to stand, and a policy that imitates them and
stands goes on standing. Here phase and amplitude are read from the legs' last control signals,
which the policy has, too; the next action is that of a full step at the next phase. Small
oscillations grow, as in a Hopf oscillator, and a robot that stands is started in one direction.

Shapes: H control signals, newest last; J joints of both legs.
"""

import functools

import numpy as np

from nerf2real.suite import specs
from nerf2real.suite.gaits import legs
from nerf2real.suite.gaits.walk import Command, Gait, GaitSettings
from nerf2real.suite.op3 import constants

HISTORY = specs.HISTORY  # control signals that the phase is read from: as many as a policy has
# Standard deviation of a driver's deviations from the gait, normalised; chosen: an action noise of
# 0.15 leaves the filter as 0.05.
_DEVIATION = 0.05
_START = 0.05  # oscillation that is added at phase 0, of a full one's 1: where standing leads
# Share of the amplitude that a step to a stand leaves; chosen: it stands within a period.
_STOPPING = 0.8
_COMMANDS = [
  Command(forward, turn) for forward in (0.0, 0.5, 1.0) for turn in (-1, -0.5, 0, 0.5, 1)
]
_PERIODS = 3  # of every command that the read-out is fitted to, after as many


class EntrainedGait(Gait):
  """The gait, entrained by what was applied; `follow` is to be called after every `act`."""

  # Its first step is a full one: after a crouch in `stop_time` it fell 3 of 24 robots with 0.33 kg
  # or more, high in the torso, within 2.2 s, after one in twice that time none.
  _crouching = 0.5

  def reset(self) -> None:
    super().reset()
    self._controls = np.tile(self._standing_control(), (HISTORY, 1))

  def follow(self, control: np.ndarray) -> None:
    """Sets filter, phase and amplitude by a control that was applied, and those before it.

    Args:
      control: Filtered control signal of the last control step [20], normalised.
    """
    self._set_filter(control)
    self._controls = np.vstack([self._controls[1:], control])
    found = self.oscillation(self._controls)
    self._amplitude = min(1.0, abs(found))
    self._phase = float(np.angle(found + _START) % (2 * np.pi))

  def oscillation(self, controls: np.ndarray) -> complex:
    """Returns amplitude and phase, as a complex number, of control signals [H, 20]."""
    standing, weights = _readout(self.settings, self._head_pan_limit)
    deviations = controls[:, legs.COLUMNS.ravel()] - standing
    return complex(*(deviations.ravel() @ weights))

  def _next_amplitude(self, ready: bool, change: float) -> float:
    return 1.0 if ready else max(0.0, _STOPPING * self._amplitude - change)


@functools.lru_cache(maxsize=8)
def _readout(settings: GaitSettings, head_pan_limit: float | None) -> tuple[np.ndarray, np.ndarray]:
  """Fits the linear read-out of a gait's phase.

  Least squares with the variance of a driver's deviations as ridge, over all commands.

  Returns:
    The legs' control signals of standing [J], and weights [H J, 2] that map deviations from them to
    the cosine and sine of the phase, times the amplitude.
  """
  standing = _march(settings, head_pan_limit, Command(step=False))[0][-1]
  inputs, targets = [], []
  for command in _COMMANDS:
    controls, phases = _march(settings, head_pan_limit, command)
    windows = np.lib.stride_tricks.sliding_window_view(controls - standing, HISTORY, axis=0)
    inputs.append(windows.swapaxes(1, 2).reshape(len(windows), -1))
    targets.append(np.stack([np.cos(phases), np.sin(phases)], -1)[HISTORY - 1 :])
  x, y = np.concatenate(inputs), np.concatenate(targets)
  ridge = len(x) * _DEVIATION**2 * np.eye(x.shape[1])
  return standing, np.linalg.solve(x.T @ x + ridge, x.T @ y)


def _march(
  settings: GaitSettings, head_pan_limit: float | None, command: Command
) -> tuple[np.ndarray, np.ndarray]:
  """Runs the clocked gait without a robot; returns control signals [N, J] and phases [N]."""
  gait = Gait(settings, head_pan_limit=head_pan_limit)
  steps = round(_PERIODS * settings.period / constants.CONTROL_TIMESTEP)
  controls, phases = [], []
  for _ in range(2 * steps):
    gait.act(command)
    controls.append(gait.control[legs.COLUMNS.ravel()])
    phases.append(gait.phase)
  return np.array(controls[steps:]), np.array(phases[steps:])
