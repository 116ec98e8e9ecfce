"""Labelled episodes: teacher and student drive in turns, the teacher labels every state."""

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import dm_env
import numpy as np

from nerf2real.agents.distill.dataset import fields, transition_fields
from nerf2real.agents.distill.schedule import Mixture
from nerf2real.agents.distill.settings import MixtureSettings
from nerf2real.agents.distill.teacher import Teacher
from nerf2real.agents.dmpo.policy.acting import Agent, episode_success, task_of
from nerf2real.agents.dmpo.policy.inference import Policy
from nerf2real.agents.dmpo.specs import BALL, FlatObservation, Layout, planar_pose
from nerf2real.agents.processes.timings import StageTimes
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose

_HEAD_PAN = constants.JOINT_NAMES.index("head_pan")
TEACHER, STUDENT, DETOUR = 0, 1, 2  # drivers, as `dataset.fields` counts them


def pose_of(layout: Layout, observation: FlatObservation) -> Pose:
  """Returns the true pose; raises ValueError where the environment does not give it."""
  if layout.pose_columns is None:
    raise ValueError("A teacher needs the true pose: the environment gives no privileged state.")
  return Pose(*(float(v) for v in planar_pose(observation.privileged, layout.pose_columns)))


def ball_of(layout: Layout, observation: FlatObservation) -> np.ndarray | None:
  """Returns where the ball is [2] [m]; None without one."""
  column = layout.privileged_column(BALL)
  return None if column is None else observation.privileged[column : column + 2]


def relative_ball(
  observation: Mapping[str, Any], pose: Pose, ball: np.ndarray | None
) -> np.ndarray | None:
  """Returns a ball [2] [m] from the robot: x ahead, y to the left [m], and the head's pan [rad]."""
  if ball is None:
    return None
  offset, cosine, sine = ball - pose.xy, np.cos(pose.yaw), np.sin(pose.yaw)
  ahead, left = cosine * offset[0] + sine * offset[1], cosine * offset[1] - sine * offset[0]
  return np.array([ahead, left, observation["joint_positions"][-1][_HEAD_PAN]])


def believed_ball(relative: np.ndarray, pose: Pose) -> np.ndarray:
  """Returns a ball [2] [m] as seen from a believed pose: its place from the robot, as pictures show
  it, is true whatever the pose is.

  Args:
    relative: from `relative_ball` [3].
    pose: the robot's, believed.
  """
  cosine, sine = np.cos(pose.yaw), np.sin(pose.yaw)
  ahead, left = relative[:2]
  return pose.xy + np.array([cosine * ahead - sine * left, sine * ahead + cosine * left])


def likeliest_pose(policy: Policy, embedding: np.ndarray, *, pan: float = 0.0) -> Pose:
  """Returns the robot's pose by the likeliest component of a student's belief.

  Args:
    policy: the student.
    embedding: of the pictures so far.
    pan: of the head [rad], by which the belief's heading, the camera's, is ahead of the robot's.
  """
  logits, means, _ = policy.belief(embedding)
  x, y, yaw = (float(value) for value in means[int(np.argmax(logits))])
  return Pose(x, y, yaw - pan)


@dataclasses.dataclass
class _Segment:
  """Who drives for how long."""

  driver: int = TEACHER
  left: int = 0
  noise: float = 0.0
  place: np.ndarray | None = None
  """Of a detour [2] [m]."""
  guide: Teacher | None = None
  """Drives the detour."""
  is_covered: bool = False
  """Whether the camera is."""


class EpisodeRunner:
  """Runs labelled episodes in an environment."""

  def __init__(
    self,
    environment: dm_env.Environment,
    layout: Layout,
    *,
    teacher: Teacher,
    settings: MixtureSettings,
    rng: np.random.Generator,
  ):
    """Creates the runner.

    Args:
      environment: from `make_environment`, with pictures and privileged state.
      layout: its layout.
      teacher: labels the states.
      settings: of the mixture.
      rng: of drivers, noise and detours.
    """
    self._environment, self._layout = environment, layout
    self._teacher, self._settings, self._rng = teacher, settings, rng
    self._free_space = task_of(environment).scene.free_space
    self.times = StageTimes()

  def run(
    self, policy: Policy | None, mixture: Mixture
  ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Runs an episode; returns its arrays (`dataset.fields`, `transition_fields`) and figures.

    Args:
      policy: the student; None while there is none.
      mixture: who drives how often.
    """
    kept = fields(self._layout) | transition_fields(self._layout)
    rows: dict[str, list[Any]] = {name: [] for name in kept}
    with self.times.stage("env"):
      timestep = self._environment.reset()
    segment = _Segment()
    agent = None
    if policy is not None:
      agent = Agent(policy, self._layout, seed=0, deterministic=True)
    flat = self._layout.flatten(timestep.observation)
    self._teacher.reset(pose_of(self._layout, flat))
    by_belief = policy is not None and self._rng.random() < mixture.belief
    since_success = 0
    while not timestep.last() and since_success <= self._settings.after_success:
      observation = timestep.observation
      goal = np.asarray(observation["goal"], np.float64)
      truth = pose = pose_of(self._layout, flat)
      ball = ball_of(self._layout, flat)
      relative = relative_ball(observation, truth, ball)
      student: np.ndarray | None = None
      if agent is not None:
        with self.times.stage("student"):
          student = np.clip(agent.act(flat), -1.0, 1.0)
          if by_belief and agent.policy.has_belief:
            pan = 0.0 if relative is None else float(relative[2])
            pose = likeliest_pose(agent.policy, agent.embedding, pan=pan)
            ball = None if relative is None else believed_ball(relative, pose)
      with self.times.stage("teacher"):
        if segment.left <= 0:
          segment = self._draw_segment(policy is not None, mixture)
        segment.left -= 1
        label = self._teacher.label(observation, goal=goal, pose=pose, ball=ball)
        action = self._choose(segment, label.action, student, observation, pose)
      with self.times.stage("env"):
        timestep = self._environment.step(action)
      values = {
        "image": flat.image,
        "state": flat.state,
        "label": label.action,
        "command": label.command,
        "pose": np.array(truth),
        "goal_distance": float(np.linalg.norm(goal - truth.xy)),
        "driver": segment.driver,
        "ball": relative,
        "action": action,
        "reward": float(timestep.reward or 0.0),
        "discount": 1.0 if timestep.discount is None else float(timestep.discount),
        "privileged": flat.privileged,
      }
      for name, row in rows.items():
        row.append(values[name])
      flat = self._layout.flatten(timestep.observation)
      if segment.is_covered and flat.image is not None:
        flat = flat._replace(image=np.zeros_like(flat.image))
      since_success += bool(episode_success(self._environment))
    arrays: dict[str, np.ndarray] = {
      name: np.asarray(rows[name], dtype) for name, (_, dtype) in kept.items()
    }
    ending = getattr(task_of(self._environment), "ending", None)
    figures = {
      "length": len(arrays["state"]),
      "success": float(since_success > 0),
      "fell": float(ending == "fall"),
      "collided": float(ending == "collision"),
      "student_share": float(np.mean(arrays["driver"] == STUDENT)),
    }
    return arrays, figures

  def _draw_segment(self, has_student: bool, mixture: Mixture) -> _Segment:
    segment = self._draw_driver(has_student, mixture)
    share = self._settings.covered_share
    segment.is_covered = share > 0 and self._rng.random() < share  # 0 draws nothing
    return segment

  def _draw_driver(self, has_student: bool, mixture: Mixture) -> _Segment:
    settings, rng = self._settings, self._rng
    left = int(rng.integers(settings.segment[0], settings.segment[1] + 1))
    if rng.random() < settings.detour_share:
      place = np.asarray(self._free_space.sample(rng, 1))[0, :2]
      # A copy has the hidden state of the one that was followed so far.
      return _Segment(DETOUR, left, place=place, guide=copy.deepcopy(self._teacher))
    if has_student and rng.random() >= mixture.teacher:
      return _Segment(STUDENT, left)
    noise = settings.noise * rng.random() if rng.random() < settings.noisy_share else 0.0
    return _Segment(TEACHER, left, noise=noise)

  def _choose(
    self,
    segment: _Segment,
    label: np.ndarray,
    student: np.ndarray | None,
    observation: Any,
    pose: Pose,
  ) -> np.ndarray:
    """Returns the action [A] of whoever drives."""
    if segment.driver == STUDENT and student is not None:
      return student
    if segment.guide is not None and segment.place is not None:
      seen = {**observation, "goal": segment.place.astype(np.float32)}
      return segment.guide.label(seen, goal=segment.place, pose=pose).action
    noise = segment.noise * self._rng.standard_normal(label.shape)
    return np.clip(label + noise, -1.0, 1.0)
