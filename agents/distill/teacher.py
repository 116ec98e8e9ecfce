"""Teachers: policies that may read privileged state and label every state that is visited.

DAgger (Ross, Gordon and Bagnell 2011, https://arxiv.org/abs/1011.0686) needs the expert's action at
the states that the student reaches. A teacher with a hidden state, such as a gait's phase, must
therefore follow what the robot really did, or its labels contradict the student's observations.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from nerf2real.agents.dmpo.policy.acting import Agent
from nerf2real.agents.dmpo.policy.export import ExportedPolicy, load_policy
from nerf2real.core.serialization import read_json
from nerf2real.suite.gaits.walk import GaitSettings
from nerf2real.suite.gaits.walker import SteeringSettings, Walker
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose

COMMAND_SIZE = 2  # forward, turn
# rad, the upper end of the paper's range: at the reference -0.47 the camera sees little but floor.
_HEAD_TILT = -0.157


class Label(NamedTuple):
  """A teacher's answer at one state."""

  action: np.ndarray  # [A], in [-1, 1]
  command: np.ndarray  # [2] forward and turn, -1 to 1; NaN where the teacher has none


class Teacher(Protocol):
  """Labels the states of an episode one after another, whoever drives."""

  def reset(self, pose: Pose) -> None:
    """Begins an episode at a pose."""

  def label(
    self,
    observation: Mapping[str, Any],
    *,
    goal: np.ndarray,
    pose: Pose,
    ball: np.ndarray | None = None,
  ) -> Label:
    """Returns what the teacher would do.

    Args:
      observation: the environment's; `previous_control` is what was applied before.
      goal: where to go, or where to push the ball [2] [m].
      pose: where the robot is, the truth or a student's belief.
      ball: where the ball is [2] [m]; None: there is none, or it does not matter.
    """


@dataclasses.dataclass(frozen=True, kw_only=True)
class WalkerSettings:
  """A scripted walker by name."""

  gait: GaitSettings
  """Parameters of the gait."""
  steering: SteeringSettings
  """And of its steering."""
  head_pan_limit: float | None = None
  """As the task's robot has it [rad]; None: the paper's table."""
  entrained: bool = False
  """Whether the gait's phase is a function of what was applied, as a student observes it, in place
  of a clock (`suite.gaits.entrained`)."""


def _steady() -> WalkerSettings:
  """The walker of the published figures, its head raised."""
  return WalkerSettings(gait=GaitSettings(), steering=SteeringSettings(head_tilt=_HEAD_TILT))


def _tall() -> WalkerSettings:
  """The steady walker with straighter knees, which need less torque to carry the same weight."""
  steady = _steady()
  height = steady.gait.height + 0.008
  return dataclasses.replace(steady, gait=dataclasses.replace(steady.gait, height=height))


def _quick() -> WalkerSettings:
  """Longer steps and larger turns, searched for by CMA-ES over gait and steering (README)."""
  gait = GaitSettings(
    stop_time=0.3668,
    max_turn=0.2875,
    period=0.4502,
    spread=0.0413,
    sway=0.0132,
    sway_lead=0.8899,
    lift=0.0364,
    swing=0.4738,
    stride=0.0707,
    backset=0.027,
    lean=0.075,
    tilt=0.0395,
    lead=0.0191,
    pitch_rate_gain=0.0051,
    roll_rate_gain=-0.0317,
    pitch_gain=0.0174,
    roll_gain=-0.2068,
  )
  steering = SteeringSettings(
    lookahead=0.3066, turn_gain=1.1875, turn_first=0.7726, head_tilt=_HEAD_TILT
  )
  return WalkerSettings(gait=gait, steering=steering)


def _swift() -> WalkerSettings:
  """Shorter and longer steps still, and curves in place of turns on the spot.

  Searched for by CMA-ES from `quick` on trials that are not the protocol's: the way from quick's
  parameters to what was found is taken by 85 %, which loses 0.2 s. With other draws than the
  search's it fell in one trial of 54.
  """
  gait = GaitSettings(
    stop_time=0.3727,
    max_turn=0.282,
    period=0.4293,
    spread=0.0413,
    sway=0.0167,
    sway_lead=1.2475,
    lift=0.0281,
    swing=0.5002,
    stride=0.086,
    backset=0.0297,
    lean=0.0479,
    tilt=0.0395,
    lead=0.0201,
    pitch_rate_gain=0.0032,
    roll_rate_gain=-0.0268,
    pitch_gain=0.0356,
    roll_gain=-0.2577,
  )
  steering = SteeringSettings(
    lookahead=0.2926, turn_gain=1.7207, turn_first=1.0907, head_tilt=_HEAD_TILT
  )
  return WalkerSettings(gait=gait, steering=steering)


def _brisk() -> WalkerSettings:
  """Longer steps again, begun and ended sooner.

  Searched for from `swift` by `benchmarks/learning/faster_walker.py`: the way to what was found is
  taken by 60 %, as all of it falls in 4 of 27 walks with strong motors on a slippery floor, and
  this in 3; `swift` in none. With nominal and weak motors neither falls, and this needs a
  twentieth and a tenth less time. Figures, and what its students came to:
  benchmarks/results/policies/navigation_faster.md.
  """
  gait = GaitSettings(
    stop_time=0.3181,
    max_turn=0.2918,
    period=0.4175,
    height=0.2004,
    spread=0.0414,
    sway=0.018,
    sway_lead=1.1701,
    lift=0.0275,
    swing=0.5055,
    stride=0.104,
    backset=0.0302,
    lean=0.0422,
    tilt=0.0395,
    lead=0.0156,
    pitch_rate_gain=0.0032,
    roll_rate_gain=-0.0268,
    pitch_gain=0.0456,
    roll_gain=-0.2293,
  )
  steering = SteeringSettings(
    lookahead=0.2779, turn_gain=1.5213, turn_first=1.0607, head_tilt=_HEAD_TILT
  )
  return WalkerSettings(gait=gait, steering=steering)


def _nimble() -> WalkerSettings:
  """As fast as `brisk` and surer of foot, with sharper turns.

  `brisk` was searched for on trials, which are short and winding; of 80 walks of 8 s, straight on
  and slightly bent in four worlds, it falls in 16, `swift` in 15 and this in 6. It was searched for
  from `brisk` on such walks (`benchmarks/learning/long_walks.py`) in the worlds 0, 2 and 3, and its
  stride is 8 % longer than what was found.
  """
  gait = GaitSettings(
    stop_time=0.2503,
    max_turn=0.3,
    period=0.4006,
    height=0.1963,
    spread=0.0424,
    sway=0.0173,
    sway_lead=1.2391,
    lift=0.0268,
    swing=0.5087,
    stride=0.1066,
    backset=0.0356,
    lean=0.0348,
    tilt=0.0438,
    lead=0.0088,
    pitch_rate_gain=0.0032,
    roll_rate_gain=-0.0268,
    pitch_gain=0.0203,
    roll_gain=-0.2175,
  )
  steering = SteeringSettings(
    lookahead=0.32, turn_gain=1.5213, turn_first=1.15, head_tilt=_HEAD_TILT
  )
  return WalkerSettings(gait=gait, steering=steering)


def _ball() -> WalkerSettings:
  """The quick gait, pushing the ball; the head looks for the ball and follows it."""
  steering = SteeringSettings(head_tilt=_HEAD_TILT, watches_ball=True)
  return WalkerSettings(
    gait=_quick().gait,
    steering=steering,
    head_pan_limit=constants.BALL_PUSHING_HEAD_PAN,
    entrained=True,
  )


TEACHERS = {
  "steady": _steady,
  "tall": _tall,
  "quick": _quick,
  "swift": _swift,
  "brisk": _brisk,
  "nimble": _nimble,
  "ball": _ball,
}


class WalkerTeacher:
  """The scripted walker; its gait follows the control that was applied."""

  def __init__(self, scene: Any, settings: WalkerSettings):
    """Creates the teacher.

    Args:
      scene: the bundle, for its free space.
      settings: of gait and steering.
    """
    self._walker = Walker(
      scene,
      gait=settings.gait,
      steering=settings.steering,
      head_pan_limit=settings.head_pan_limit,
      entrained=settings.entrained,
    )
    self._begun = False

  def reset(self, pose: Pose) -> None:
    self._walker.reset(pose)
    self._begun = False

  def label(
    self,
    observation: Mapping[str, Any],
    *,
    goal: np.ndarray,
    pose: Pose,
    ball: np.ndarray | None = None,
  ) -> Label:
    if self._begun:
      self._walker.follow(observation["previous_control"][-1])
    self._begun = True
    action = self._walker.act(observation, goal=goal, pose=pose, ball=ball)
    command = self._walker.command
    return Label(action, np.array([command.forward, command.turn], np.float32))


class PolicyTeacher:
  """An exported policy, such as one that was trained from state; its LSTM steps at every label."""

  def __init__(self, loaded: ExportedPolicy):
    self._agent = Agent(loaded.policy, loaded.layout, seed=0, deterministic=True)

  def reset(self, pose: Pose) -> None:
    self._agent.reset()

  def label(
    self,
    observation: Mapping[str, Any],
    *,
    goal: np.ndarray,
    pose: Pose,
    ball: np.ndarray | None = None,
  ) -> Label:
    action = self._agent.act(self._agent.layout.flatten(observation))
    unknown = np.full(COMMAND_SIZE, np.nan, np.float32)
    return Label(np.clip(action, -1.0, 1.0).astype(np.float32), unknown)


def make_teacher(name: str, scene: Any) -> Teacher:
  """Returns a teacher by its name in TEACHERS, from a walker's JSON, or from a policy's folder.

  Raises:
    ValueError: it is none of these, or the file holds no `WalkerSettings`.
  """
  if name in TEACHERS:
    return WalkerTeacher(scene, TEACHERS[name]())
  path = Path(name)
  if path.suffix == ".json" and path.is_file():
    return WalkerTeacher(scene, read_json(path, WalkerSettings))
  if not path.is_dir():
    raise ValueError(
      f"Unknown teacher {name!r}: expected one of {', '.join(TEACHERS)}, the JSON of a walker's "
      "settings, or the folder of an exported policy."
    )
  return PolicyTeacher(load_policy(name))
