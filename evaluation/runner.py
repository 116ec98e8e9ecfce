"""Runs trials on a plant and classifies each: success, collision, fall, or lost."""

import base64
from collections.abc import Callable, Iterable

import cv2
import dm_env
import numpy as np

from nerf2real.evaluation import episodes
from nerf2real.evaluation.episodes import Episode, Moment, Setting
from nerf2real.evaluation.plants.operated import RepeatError
from nerf2real.evaluation.plants.plant import Plant, Sight, Trial
from nerf2real.evaluation.policies.policy import EvaluatedPolicy, resolution
from nerf2real.suite.op3 import constants

_STEP = constants.CONTROL_TIMESTEP
_PATH_STEPS = round(0.2 / _STEP)  # control steps between points of a path
_MOMENT_STEPS = round(0.5 / _STEP)  # and between beliefs that are kept


def setting_of(plant: Plant, policy: EvaluatedPolicy) -> Setting:
  """Returns what the episodes of a policy on a plant belong to."""
  return Setting(
    policy=policy.name,
    policy_id=policy.policy_id,
    resolution=resolution(policy),
    plant=plant.name,
    plant_id=plant.plant_id,
    protocol=plant.protocol,
    perturbation=plant.perturbation,
    control=policy.control,
    conditions=plant.conditions,
  )


class _Trace:
  """Collects what is kept of an episode."""

  def __init__(self) -> None:
    self.path: list[list[float]] = []
    self.ball: list[list[float]] = []
    self.moments: list[Moment] = []
    self.errors: list[float] = []

  def add(self, step: int, sight: Sight, policy: EvaluatedPolicy, picture: np.ndarray | None):
    """Notes one control step."""
    time = round(step * _STEP, 3)
    pose, belief = sight.pose, policy.belief
    if step % _PATH_STEPS == 0:
      if pose is not None:
        self.path.append([time, *(round(float(value), 3) for value in pose)])
      if sight.ball is not None:
        self.ball.append([time, *(round(float(value), 3) for value in sight.ball)])
    if belief is None:
      return
    if pose is not None:
      self.errors.append(float(np.linalg.norm(belief.position - pose.xy)))
    if step % _MOMENT_STEPS == 0:
      self.moments.append(
        Moment(
          time=time,
          position=None if pose is None else (float(pose.x), float(pose.y)),
          logits=np.round(belief.logits, 4).tolist(),
          means=np.round(belief.means, 4).tolist(),
          stddevs=np.round(belief.stddevs, 4).tolist(),
          picture="" if picture is None else _encode(picture),
        )
      )


def _encode(picture: np.ndarray) -> str:
  _, data = cv2.imencode(".png", picture[..., ::-1])
  return base64.b64encode(data.tobytes()).decode()


Watch = Callable[[dm_env.TimeStep, EvaluatedPolicy], None]
"""Called with every step of an episode, the first one included, and the policy."""


def unwatched(timestep: dm_env.TimeStep, policy: EvaluatedPolicy) -> None:
  """Looks at nothing."""


def run_trial(
  plant: Plant,
  policy: EvaluatedPolicy,
  trial: Trial,
  *,
  group: str,
  index: int,
  watch: Watch = unwatched,
) -> Episode:
  """Runs one trial; it ends at the goal, on a failure or at the time limit.

  Args:
    plant: Where.
    policy: Who acts.
    trial: Where it starts.
    group: Of the trial within its protocol.
    index: Of the trial in its protocol.
    watch: Called at every step.
  """
  timestep = plant.start(trial)
  watch(timestep, policy)
  sight = plant.sight()
  policy.reset(sight, seed=trial.seed)
  trace, step, reached = _Trace(), 0, False
  while True:
    action = policy.act(timestep.observation, goal=plant.goal, sight=sight)
    trace.add(step, sight, policy, timestep.observation.get("camera"))
    timestep = plant.step(action)
    watch(timestep, policy)
    step += 1
    sight = plant.sight()
    failed = sight.collided or sight.fallen
    reached = not failed and bool(plant.reached(sight))
    if reached or failed or timestep.last():
      break
  outcome, time, detail = _classify(plant, sight, reached, step)
  judged = plant.judge()
  if judged is not None:
    outcome, time, detail = judged
  x, y = (float(value) for value in plant.goal)
  return Episode(
    setting=setting_of(plant, policy),
    group=group,
    index=index,
    goal=(x, y),
    outcome=outcome,
    detail=detail,
    time=time,
    duration=round(step * _STEP, 3),
    localisation_error=float(np.mean(trace.errors)) if trace.errors else None,
    path=trace.path,
    ball_path=trace.ball,
    moments=trace.moments,
  )


def _classify(
  plant: Plant, sight: Sight, reached: bool, steps: int
) -> tuple[str, float | None, str]:
  """Returns outcome, time [s] to the goal and detail."""
  if reached:
    return episodes.SUCCESS, round(steps * _STEP, 3), ""
  if sight.collided:
    return episodes.COLLISION, None, "fell after it" if sight.fallen else ""
  if sight.fallen:
    return episodes.FALL, None, ""
  stopped = plant.stopped()
  if stopped:
    return episodes.STOPPED, None, stopped
  return episodes.LOST, None, "time limit"


def run_all(
  plant: Plant,
  policy: EvaluatedPolicy,
  trials: Iterable[tuple[int, tuple[str, Trial]]],
  *,
  store: episodes.Store,
  report: Callable[[Episode, int, int], None] = lambda episode, number, count: None,
  watch: Watch = unwatched,
  share: tuple[int, int] = (0, 1),
) -> int:
  """Runs the trials that the store does not hold yet; returns how many were run.

  Args:
    plant: Where.
    policy: Who acts.
    trials: Index in the plant's protocol, and group and trial.
    store: Keeps every episode as it ends.
    report: Called with an episode, its number and the number of trials.
    watch: Called at every step of every episode.
    share: k and n, of n processes that share the trials the k-th: every n-th trial from the k-th.
  """
  setting, done = setting_of(plant, policy), store.done()
  listed = list(trials)
  count = 0
  for number, (index, (group, trial)) in enumerate(listed, start=1):
    probe = Episode(setting=setting, group=group, index=index, goal=(0.0, 0.0), outcome="")
    if probe.key in done or (number - 1) % share[1] != share[0]:
      continue
    while True:
      try:
        episode = run_trial(plant, policy, trial, group=group, index=index, watch=watch)
        break
      except RepeatError:
        continue
    store.add(episode)
    count += 1
    report(episode, number, len(listed))
  return count
