"""The collector: runs episodes that teacher and student drive in turns, and labels every state.

A process of its own; the learner says over the link what to run, and gives the newest student. An
episode is sent whole when it ends, and kept until the learner has acknowledged it.
"""

import copy
import dataclasses
import logging
import threading
import time
import urllib.parse
from typing import Any, NamedTuple

import dm_env
import numpy as np

from nerf2real.agents.distill.dataset import fields
from nerf2real.agents.distill.settings import DistillSettings, MixtureSettings
from nerf2real.agents.distill.teacher import Teacher, make_teacher
from nerf2real.agents.dmpo.acting import episode_success, task_of
from nerf2real.agents.dmpo.inference import Policy, PolicyState
from nerf2real.agents.dmpo.specs import FlatObservation, Layout, planar_pose
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.processes.environments import make_environment
from nerf2real.agents.processes.timings import StageTimes
from nerf2real.core.serialization import from_plain
from nerf2real.suite.gaits.walker import Pose

_log = logging.getLogger(__name__)
_AWAY_POLL = 0.5  # s between questions while the learner does not answer
_DRAIN = 5.0  # s to deliver what was made, at the end
_MAX_FAILURES = 5  # episodes in a row
_MAX_UNDELIVERED = 8  # episodes in the outbox, from which the collector waits for the learner
TEACHER, STUDENT, DETOUR = 0, 1, 2
_NO_PUSH = 1e-6  # N


class Mixture(NamedTuple):
  """Shares of one moment of the run."""

  teacher: float  # of the segments
  belief: float  # of the episodes whose teacher is given the student's belief


def mixture_at(settings: MixtureSettings, frames: int, *, begun: int | None) -> Mixture:
  """Returns the mixture after a number of frames.

  Args:
    settings: of the mixture.
    frames: of the run so far.
    begun: frames at which the first student was there; None before it.
  """
  if begun is None:
    return Mixture(1.0, 0.0)
  progress = float(np.clip((frames - begun) / max(settings.anneal_frames, 1), 0.0, 1.0))
  teacher = settings.first_share + progress * (settings.last_share - settings.first_share)
  return Mixture(teacher, progress * settings.belief_share)


def push_level(settings: DistillSettings, frames: int) -> tuple[float, float]:
  """Returns the range of pushes' forces [N] after a number of frames."""
  return [(low, high) for first, low, high in settings.push_forces if frames >= first][-1]


def pushed(environment: str, forces: tuple[float, float]) -> str:
  """Returns an environment's name with pushes of these forces [N], or with none."""
  path, _, query = environment.partition("?")
  options = dict(urllib.parse.parse_qsl(query))
  if forces[1] < _NO_PUSH:
    options["pushes"] = "false"
  else:
    options |= {"pushes": "true", "push_force": f"{forces[0]},{forces[1]}"}
  return f"{path}?{urllib.parse.urlencode(options, safe='/,')}"


def pose_of(layout: Layout, observation: FlatObservation) -> Pose:
  """Returns the true pose; raises ValueError where the environment does not give it."""
  if layout.pose_columns is None:
    raise ValueError("A teacher needs the true pose: the environment gives no privileged state.")
  return Pose(*(float(v) for v in planar_pose(observation.privileged, layout.pose_columns)))


def likeliest_pose(policy: Policy, embedding: np.ndarray) -> Pose:
  """Returns the mean of the likeliest component of a student's belief."""
  logits, means, _ = policy.belief(embedding)
  return Pose(*(float(value) for value in means[int(np.argmax(logits))]))


@dataclasses.dataclass
class _Segment:
  """Who drives for how long."""

  driver: int = TEACHER
  left: int = 0
  noise: float = 0.0
  place: np.ndarray | None = None  # of a detour [2] [m]
  guide: Teacher | None = None  # drives the detour


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
    """Runs an episode; returns its arrays (`dataset.fields`) and its figures.

    Args:
      policy: the student; None while there is none.
      mixture: who drives how often.
    """
    rows: dict[str, list[Any]] = {name: [] for name in fields(self._layout)}
    with self.times.stage("env"):
      timestep = self._environment.reset()
    segment, state = _Segment(), policy.initial_state() if policy else None
    flat = self._layout.flatten(timestep.observation)
    self._teacher.reset(pose_of(self._layout, flat))
    by_belief = policy is not None and self._rng.random() < mixture.belief
    since_success = 0
    while not timestep.last() and since_success <= self._settings.after_success:
      observation = timestep.observation
      goal = np.asarray(observation["goal"], np.float64)
      truth = pose = pose_of(self._layout, flat)
      student: np.ndarray | None = None
      if policy is not None:
        with self.times.stage("student"):
          student, state, believed = self._step_student(policy, flat, state)
        pose = believed if by_belief and believed is not None else truth
      with self.times.stage("teacher"):
        label = self._teacher.label(observation, goal=goal, pose=pose)
        if segment.left <= 0:
          segment = self._draw_segment(policy is not None, mixture)
        segment.left -= 1
        action = self._choose(segment, label.action, student, observation, pose)
      image = flat.image
      values = (
        image,
        flat.state,
        label.action,
        label.command,
        np.array(truth),
        float(np.linalg.norm(goal - truth.xy)),
        segment.driver,
      )
      for row, value in zip(rows.values(), values, strict=True):
        row.append(value)
      with self.times.stage("env"):
        timestep = self._environment.step(action)
      flat = self._layout.flatten(timestep.observation)
      since_success += bool(episode_success(self._environment))
    arrays: dict[str, np.ndarray] = {
      name: np.asarray(rows[name], dtype) for name, (_, dtype) in fields(self._layout).items()
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

  def _step_student(
    self, policy: Policy, flat: FlatObservation, state: PolicyState | None
  ) -> tuple[np.ndarray, PolicyState, Pose | None]:
    assert state is not None
    step = policy.step(flat.image, flat.state, state)
    believed = likeliest_pose(policy, step.embedding) if policy.has_belief else None
    return np.clip(step.mean, -1.0, 1.0), step.state, believed

  def _draw_segment(self, has_student: bool, mixture: Mixture) -> _Segment:
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


class Collector:
  """Runs labelled episodes for a learner until the run is over."""

  def __init__(self, link: ActorLink, *, seed: int, index: int):
    """Joins the run that the link leads to.

    Args:
      link: an actor's link.
      seed: the run's; with the index, where the learner began and how many were in this one's place
        before, it makes the seeds of environment and mixture.
      index: this collector's number in the run.
    """
    self._link = link
    self._stop = threading.Event()
    answer = wait_for_description(link, self._stop)
    description = answer["description"]
    self._settings = from_plain(description["settings"], DistillSettings)
    self._layout = from_plain(description["layout"], Layout)
    entropy = (seed, index, description["begin_frames"], answer["predecessors"])
    self._seeds = np.random.SeedSequence(entropy)
    self._policy: Policy | None = None
    self._begun: int | None = description["begun"]
    self._level: tuple[float, float] | None = None
    self._runner: EpisodeRunner | None = None

  def stop(self) -> None:
    """Ends `run`; safe in a signal handler."""
    self._stop.set()

  def run(self) -> None:
    """Collects until the run is over or `stop` is called.

    Raises:
      RuntimeError: several episodes in a row ended in an exception.
    """
    failures = 0
    try:
      while not self._stop.is_set():
        frames = self._ask()
        if frames is None:
          break
        try:
          self._episode(frames)
          failures = 0
        except Exception as error:
          failures += 1
          _log.error("An episode failed (%d in a row).", failures, exc_info=error)
          if failures >= _MAX_FAILURES:
            raise RuntimeError(f"{failures} episodes in a row failed: {error}") from error
    finally:
      self._link.drain(timeout=_DRAIN)

  def _ask(self) -> int | None:
    """Fetches the newest student; returns the run's frames, or None at its end."""
    while not self._stop.is_set():
      grant = self._link.request(0)
      if grant is None or self._link.outbox.size > _MAX_UNDELIVERED:
        self._link.flush()
        self._stop.wait(_AWAY_POLL)
        continue
      if grant["stop"]:
        return None
      if grant["version"] != self._link.version:
        answer = self._link.parameters()
        if answer is not None:
          self._policy = student_policy(answer[1], self._settings)
          self._begun = grant["steps"] if self._begun is None else self._begun
      return int(grant["steps"])
    return None

  def _episode(self, frames: int) -> None:
    level = push_level(self._settings, frames)
    if self._runner is None or level != self._level:
      self._runner, self._level = self._make_runner(level), level
    begin = time.perf_counter()
    mixture = mixture_at(self._settings.mixture, frames, begun=self._begun)
    arrays, figures = self._runner.run(self._policy, mixture)
    # The link counts a trajectory's transitions by its rewards: one less than observations.
    self._link.send(arrays | {"reward": np.zeros(len(arrays["state"]) + 1, np.float32)})
    steps = len(arrays["state"])
    rates = {"steps_per_second": steps / (time.perf_counter() - begin), "push_force": level[1]}
    about = {"teacher_share": mixture.teacher, "belief_share": mixture.belief}
    self._link.report(figures | rates | about | self._runner.times.take(steps))

  def _make_runner(self, level: tuple[float, float]) -> EpisodeRunner:
    environment_seed, mixture_seed = (int(s) for s in self._seeds.spawn(1)[0].generate_state(2))
    environment = make_environment(pushed(self._settings.environment, level), seed=environment_seed)
    found = Layout.of(environment)
    if found != self._layout:
      raise ValueError(
        f"{self._settings.environment} is not the learner's here: expected {self._layout}, found "
        f"{found}. Install the same release and scene."
      )
    return EpisodeRunner(
      environment,
      self._layout,
      teacher=make_teacher(self._settings.teacher, task_of(environment).scene),
      settings=self._settings.mixture,
      rng=np.random.default_rng(mixture_seed),
    )


def wait_for_description(link: ActorLink, stop: threading.Event) -> dict[str, Any]:
  """Returns the learner's answer to "status" as soon as there is one."""
  while not stop.is_set():
    answer = link.status()
    if answer is not None:
      return answer
    stop.wait(_AWAY_POLL)
  raise InterruptedError("Stopped while waiting for the learner.")


def student_policy(parameters: dict[str, np.ndarray], settings: DistillSettings) -> Policy:
  """Returns the policy that runs a student's served parameters."""
  network = settings.agent.network
  return Policy(parameters, init_stddev=network.init_stddev, min_stddev=network.min_stddev)
