"""A gait for the OP3: swaying, lifting and stepping along sines, held upright by feedback.

The pattern is open loop: one phase runs on, the feet follow curves of it in a frame that stands
upright over the floor, and `legs` turns them into joint positions. Because the servos are P-only
and the control signal is filtered, the targets lead the pattern; the filter is inverted exactly
within its bounds. Feedback of the turning rates and the tilt acts on ankles and hips. Parameters
were searched for with `launch/tune_gait.py`.

Where something else than this gait drives the robot, `follow` keeps its hidden state (filter, phase
and amplitude) at what was really applied, so that its next action fits the robot's motion.
"""

import dataclasses

import numpy as np

from nerf2real.suite.gaits import legs
from nerf2real.suite.op3 import constants
from nerf2real.suite.sensors import filters

_TIMESTEP = constants.CONTROL_TIMESTEP
_HEAD = [constants.JOINT_NAMES.index(name) for name in ("head_pan", "head_tilt")]
# rad by which `follow` corrects the phase in a control step; chosen: a third of what the gait
# itself advances, so that half a period is caught up in 26 steps.
_PHASE_CORRECTION = 0.12
_ROVING = 8  # further phases that `follow` tries in turn
_JUMP_SHARE = 0.5  # of the present mismatch below which it takes one of them; chosen
_LOCKABLE = 0.5  # amplitude from which the legs determine the phase; chosen


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaitSettings:
  """Parameters of the gait; all but the first three were found by search."""

  stop_time: float = 0.4
  """s over which steps grow from nothing and shrink again; chosen: about a period."""
  max_turn: float = 0.25
  """rad of hip yaw in a turning step; the joints' limit is 0.3."""
  period: float = 0.4241
  """s for a left and a right step."""
  height: float = 0.2014
  """m from the ankles up to the hips, standing."""
  spread: float = 0.0409
  """m that each foot stands outside of its hip."""
  sway: float = 0.0126
  """m of the hips' sideways motion."""
  sway_lead: float = 0.9164
  """rad by which the sway is ahead of the steps."""
  lift: float = 0.0338
  """m that a foot is lifted."""
  swing: float = 0.4715
  """Share of the period that a foot is lifted."""
  stride: float = 0.0529
  """m of a full step of one foot forward."""
  backset: float = 0.0299
  """m that the feet stand behind the hips."""
  lean: float = 0.0832
  """rad that the torso leans forward."""
  tilt: float = 0.0391
  """rad that the stance hip is raised against sagging."""
  lead: float = 0.017
  """s that the targets are ahead of the pattern: the servos' lag."""
  pitch_rate_gain: float = 0.0052
  """s: rad of ankle pitch per rad/s of pitching."""
  roll_rate_gain: float = -0.0316
  """s: rad of ankle roll per rad/s of rolling."""
  pitch_gain: float = 0.0188
  """rad of ankle pitch per rad of pitch error."""
  roll_gain: float = -0.2117
  """rad of ankle roll per rad of roll."""
  shift: float = 0.0
  """m that both feet stand left of the hips' middle: below a centre of mass that lies there."""


@dataclasses.dataclass(frozen=True)
class Command:
  """What the walker shall do."""

  forward: float = 0.0
  """-1 to 1: share of the full stride."""
  turn: float = 0.0
  """-1 to 1: share of the full turning step, positive to the left."""
  step: bool = True
  """False: come to a stand."""
  head: tuple[float, float] | None = None
  """Pan, tilt [rad]; None: as in the reference pose."""


class Gait:
  """The gait: one action a control step."""

  _crouching = 1.0  # how fast it takes its own posture at first, of the rate of its other changes

  def __init__(self, settings: GaitSettings | None = None, *, head_pan_limit: float | None = None):
    """Creates a gait.

    Args:
      settings: Parameters.
      head_pan_limit: As the task's robot has it; see `suite.op3.constants.joint_limits`.
    """
    self.settings = settings or GaitSettings()
    self._head_pan_limit = head_pan_limit
    lower, upper = constants.joint_limits(head_pan=head_pan_limit)
    self._middle, self._half_range = (lower + upper) / 2, (upper - lower) / 2
    self._standing = constants.standing_targets()
    self._filter = filters.ExponentialFilter(constants.ACTION_FILTER)
    self.reset()

  def reset(self) -> None:
    """Begins an episode: the robot stands in the reference pose."""
    self._filter.reset(self._standing_control())
    self._before = self._standing_control()  # filter's value before the last action
    self._phase = 0.0
    self._roving = 0
    self._amplitude = 0.0
    self._forward = self._turn = 0.0
    self._crouched = 0.0  # share of the way from the reference pose to the gait's own
    self._head: tuple[float, float] | None = None
    self._feedback: tuple[np.ndarray | None, np.ndarray | None] = (None, None)

  def _standing_control(self) -> np.ndarray:
    return (self._standing - self._middle) / self._half_range

  @property
  def phase(self) -> float:
    """Phase of the gait [rad]; the left foot swings about pi / 2, the right about 3 pi / 2."""
    return self._phase

  @property
  def control(self) -> np.ndarray:
    """Control signal [20], normalised, that the last action leads to, or that was applied since."""
    assert self._filter.value is not None
    return self._filter.value

  def act(
    self,
    command: Command,
    *,
    gyroscope: np.ndarray | None = None,
    gravity: np.ndarray | None = None,
  ) -> np.ndarray:
    """Returns the next action [20], normalised, float32.

    Args:
      command: What to do.
      gyroscope: Turning rates of the torso [3] [rad/s]; None: no feedback.
      gravity: Direction of gravity in the torso's frame [3]; None: no feedback.
    """
    settings = self.settings
    change = _TIMESTEP / settings.stop_time
    self._crouched = min(1.0, self._crouched + self._crouching * change)
    ready = self._crouched >= 1.0 and command.step
    self._amplitude = self._next_amplitude(ready, change)
    self._forward += float(np.clip(command.forward - self._forward, -change, change))
    self._turn += float(np.clip(command.turn - self._turn, -change, change))
    if self._amplitude > 0:
      self._phase = (self._phase + 2 * np.pi * _TIMESTEP / settings.period) % (2 * np.pi)
    else:
      self._phase = 0.0
    self._head, self._feedback = command.head, (gyroscope, gravity)
    return self._invert(self._targets(self._phase, self._amplitude))

  def _next_amplitude(self, ready: bool, change: float) -> float:
    return self._amplitude + float(np.clip(ready - self._amplitude, -change, change))

  def follow(self, control: np.ndarray) -> None:
    """Sets the hidden state to a control that was applied in place of this gait's own.

    To be called after `act`. The filter takes the control's value. The phase is locked to it: of
    the present phase, one a little before, one a little behind and one further away, a different
    one at every call, that is kept from which this gait's own control would have come nearest in
    the legs. The amplitude sinks, twice as fast as `act` raises it, while a lower one comes nearer.

    Args:
      control: Filtered control signal of the last control step [20], normalised.
    """
    before = self._before
    control = self._set_filter(control)
    if self._amplitude < _LOCKABLE:
      return

    def mismatch(phase: float, amplitude: float) -> float:
      wanted = self._wanted(self._targets(phase, amplitude))
      own = before + (1 - self._filter.strength) * (self._inverse(wanted, before) - before)
      return float(np.sum((own - control)[legs.COLUMNS] ** 2))

    phase, present = self._phase, mismatch(self._phase, self._amplitude)
    self._roving = (self._roving + 1) % _ROVING
    for step, share in (
      (-_PHASE_CORRECTION, 1.0),
      (_PHASE_CORRECTION, 1.0),
      (2 * np.pi * (self._roving + 0.5) / _ROVING, _JUMP_SHARE),
    ):
      found = mismatch(self._phase + step, self._amplitude)
      if found < share * present:
        phase, present = self._phase + step, found
    self._phase = phase % (2 * np.pi)
    lower = self._amplitude - 2 * _TIMESTEP / self.settings.stop_time
    if mismatch(phase, lower) < present:
      self._amplitude = lower

  def _set_filter(self, control: np.ndarray) -> np.ndarray:
    self._before = np.asarray(control, np.float64)
    self._filter.reset(self._before)
    return self._before

  def _targets(self, phase: float, amplitude: float) -> np.ndarray:
    """Returns the position targets [20] that shall leave the action filter."""
    settings = self.settings
    gyroscope, gravity = self._feedback
    ahead = phase + 2 * np.pi * settings.lead / settings.period
    pattern = self.pattern(ahead, self._forward, self._turn, amplitude)
    targets = self._standing.copy()
    if self._head is not None:
      targets[_HEAD] += self._crouched * (np.asarray(self._head) - targets[_HEAD])
    if gyroscope is not None:
      roll = settings.roll_rate_gain * gyroscope[0]
      pitch = settings.pitch_rate_gain * gyroscope[1]
      if gravity is not None:
        roll += settings.roll_gain * -np.arctan2(gravity[1], -gravity[2])
        pitch += settings.pitch_gain * (np.arctan2(gravity[0], -gravity[2]) - settings.lean)
      # An ankle that gives way to the fall pushes the floor back.
      pattern[:, 4] += pitch
      pattern[:, 5] += roll
    joints = legs.joint_positions(*pattern)
    share = self._crouched
    targets[legs.COLUMNS] = (1 - share) * targets[legs.COLUMNS] + share * joints
    return targets

  def pattern(self, phase: float, forward: float, turn: float, amplitude: float) -> np.ndarray:
    """Returns both legs' angles [2, 6] [rad], right-hand rule, at a phase [rad]."""
    settings = self.settings
    sway = amplitude * settings.sway * np.sin(phase + settings.sway_lead)  # positive: to the right
    angles = []
    for side, own_phase in zip(legs.SIDES, (phase, phase - np.pi), strict=True):
      progress, lifted = _foot(own_phase, settings.swing)
      reach = amplitude * progress  # -1 behind, 1 ahead
      ankle = np.array(
        [
          reach * forward * settings.stride / 2 - settings.backset,
          side * settings.spread + sway + settings.shift,
          amplitude * lifted * settings.lift - settings.height,
        ]
      )
      cosine, sine = np.cos(settings.lean), np.sin(settings.lean)
      x, z = cosine * ankle[0] - sine * ankle[2], sine * ankle[0] + cosine * ankle[2]
      leg = legs.leg_angles(
        np.array([x, ankle[1], z]),
        foot_roll=0.0,
        foot_pitch=-settings.lean,
        yaw=reach * turn * settings.max_turn / 2,
      )
      # The other foot is lifted: this hip carries the torso and sags inwards.
      _, other = _foot(own_phase - np.pi, settings.swing)
      leg[1] += side * amplitude * other * settings.tilt
      angles.append(leg)
    return np.stack(angles)

  def _wanted(self, targets: np.ndarray) -> np.ndarray:
    """Returns the control signal [20] that brings position targets about, within the limits."""
    return np.clip((targets - self._middle) / self._half_range, -1.0, 1.0)

  def _inverse(self, wanted: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Returns the action whose filtered value, from `before`, comes nearest to a control [20]."""
    strength = self._filter.strength
    return np.clip((wanted - strength * before) / (1 - strength), -1.0, 1.0)

  def _invert(self, targets: np.ndarray) -> np.ndarray:
    """Returns the action whose filtered value comes nearest to the targets."""
    self._before = self.control
    action = self._inverse(self._wanted(targets), self._before).astype(np.float32)
    self._filter(action)
    return action


def _foot(phase: float, swing: float) -> tuple[float, float]:
  """Returns where a foot is in its step (-1 behind to 1 ahead) and how high (0 to 1).

  The swing lies symmetrically about the phase pi / 2.
  """
  turns = (phase / (2 * np.pi) - 0.25 + swing / 2) % 1.0
  if turns < swing:
    share = turns / swing
    return float(-np.cos(np.pi * share)), float(np.sin(np.pi * share) ** 2)
  share = (turns - swing) / (1 - swing)
  return 1.0 - 2.0 * share, 0.0
