"""Labels an earlier run's episodes anew: a teacher that changed needs no data of its own.

A teacher that answers for recorded observations, poses and balls needs no simulation. Everything
but labels and commands stays as it was recorded; where there is a ball to look at, the head's tilt,
too, is the teacher's, and what the head sees is rendered (`turned_heads.py`).
"""

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.agents.distill.collecting import episodes
from nerf2real.agents.distill.dataset import fields, transition_fields
from nerf2real.agents.distill.settings import DistillSettings
from nerf2real.agents.distill.teacher import Teacher, make_teacher
from nerf2real.agents.distill.turned_heads import TILT, TurnedHead
from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.dmpo.replay.prior import read_arrays
from nerf2real.agents.dmpo.specs import BALL, FlatObservation, Layout
from nerf2real.agents.environments.loading import make_environment
from nerf2real.core import files
from nerf2real.suite import specs
from nerf2real.suite.sensors.light import draw_light

_log = logging.getLogger(__name__)


def observations(layout: Layout, state: np.ndarray) -> Iterator[dict[str, np.ndarray]]:
  """Yields the observations that flattened ones [T, S] were made of, without pictures."""
  bounds = np.cumsum(layout.state_sizes)[:-1]
  parts = dict(zip(layout.state_names, np.split(state, bounds, axis=1), strict=True))
  for step in range(len(state)):
    yield {
      name: part[step].reshape(specs.HISTORY, -1) if name in specs.PROPRIOCEPTION else part[step]
      for name, part in parts.items()
    }


def relabelled(
  episode: Mapping[str, np.ndarray], layout: Layout, teacher: Teacher, *, task: Any = None
) -> dict[str, np.ndarray]:
  """Returns an episode with a teacher's labels and commands, at true poses.

  Args:
    episode: arrays of `dataset.fields` and `transition_fields`.
    layout: of the environment that it was collected in.
    teacher: answers for recorded states, such as a scripted walker.
    task: of ball pushing, to turn the head in; None: it stays as it was.
  """
  found = {name: np.array(array) for name, array in episode.items()}
  head = None if task is None else TurnedHead(task, layout, episode)
  for step, observation in enumerate(observations(layout, found["state"])):
    if head is not None:
      head.show(observation)  # a view of what was found
      found["image"][step] = head.picture(step)
    flat = FlatObservation(None, episode["state"][step], episode["privileged"][step])
    pose = episodes.pose_of(layout, flat)
    if step == 0:
      teacher.reset(pose)
    goal, ball = np.asarray(observation["goal"], np.float64), episodes.ball_of(layout, flat)
    label = teacher.label(observation, goal=goal, pose=pose, ball=ball)
    found["label"][step], found["command"][step] = label.action, label.command
    if head is not None:
      found["action"][step, TILT] = head.follow(label.action)
  return found


def relabel_for(settings: DistillSettings, source: Path, target: Path, *, seed: int) -> int:
  """Labels the episodes of a folder anew for a run: `relabel` with its environment and teacher."""
  environment = make_environment(settings.environment, seed=seed)
  layout, task = Layout.of(environment), task_of(environment)
  target.mkdir(parents=True, exist_ok=True)
  teacher = make_teacher(settings.teacher, task.scene)
  turned = None if layout.privileged_column(BALL) is None else task
  try:
    return relabel(source, target, layout=layout, teacher=teacher, task=turned, seed=seed)
  finally:
    environment.close()


def relabel(
  source: Path,
  target: Path,
  *,
  layout: Layout,
  teacher: Teacher,
  task: Any = None,
  seed: int = 0,
) -> int:
  """Writes the episodes of a folder to another one, labelled anew; returns their frames.

  Args:
    source: `data/` of an earlier run.
    target: of the new run.
    layout: of both runs' environments.
    teacher: see `relabelled`.
    task: see `relabelled`.
    seed: of the light in which an episode's pictures are rendered, where its light is drawn.

  Raises:
    ValueError: the folder holds no episodes, damaged ones, or those of another environment.
  """
  wanted = fields(layout) | transition_fields(layout)
  paths = sorted(source.glob("[0-9]*.npz"))
  if not paths:
    raise ValueError(f"{source} holds no episodes: give the folder data of a distillation.")
  frames, rng = 0, np.random.default_rng(seed)
  for path in paths:
    episode = read_arrays(path)
    shapes = {name: episode[name].shape[1:] for name in wanted if name in episode}
    if shapes != {name: shape for name, (shape, _) in wanted.items()}:
      raise ValueError(f"{path} is of another environment than {target} is for: found {shapes}.")
    if task is not None and task.settings.randomisation.light:
      task.robot_camera.set_light(draw_light(rng))
    with files.atomic_path(target / path.name) as partial:
      np.savez(partial, **relabelled(episode, layout, teacher, task=task))  # type: ignore[arg-type]
    frames += len(episode["state"])
    _log.info("Labelled %d frames anew.", frames)
  return frames
