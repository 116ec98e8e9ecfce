"""Schedules of a distillation: stages, learning rate, shares of the drivers, forces of pushes."""

from typing import NamedTuple

import numpy as np

from nerf2real.agents.distill.settings import DistillSettings, MixtureSettings
from nerf2real.agents.environments.loading import with_options

_FINAL_RATE = 0.02  # of the learning rate, at a stage's end
_NO_PUSH = 1e-6  # N
BORROWED = 1
"""Version of the student that a run begins with; one of the run's own has 1 + its updates."""


def stage_at(settings: DistillSettings, progress: float) -> tuple[int, float]:
  """Returns the stage's index and the progress within it, at a progress of the run in [0, 1]."""
  begin = 0.0
  for index, stage in enumerate(settings.stages):
    if progress < begin + stage.share or index == len(settings.stages) - 1:
      return index, min(1.0, (progress - begin) / stage.share)
    begin += stage.share
  raise AssertionError("a distillation has at least one stage")


def cosine(progress: float) -> float:
  """The learning rate's factor: from 1 to `_FINAL_RATE` along half a cosine."""
  return _FINAL_RATE + (1 - _FINAL_RATE) * 0.5 * (1 + float(np.cos(np.pi * progress)))


class Mixture(NamedTuple):
  """Shares of one moment of the run."""

  teacher: float  # of the segments
  belief: float  # of the episodes whose teacher is given the student's belief


def mixture_at(
  settings: MixtureSettings, frames: int, *, begun: int | None, is_borrowed: bool = False
) -> Mixture:
  """Returns the mixture after a number of frames.

  Args:
    settings: of the mixture.
    frames: of the run so far.
    begun: frames at which the run's first own student was there; None before it.
    is_borrowed: whether before it the student that the run begins with drives beside the teacher.
  """
  if begun is None:
    return Mixture(settings.first_share if is_borrowed else 1.0, 0.0)
  progress = float(np.clip((frames - begun) / max(settings.anneal_frames, 1), 0.0, 1.0))
  teacher = settings.first_share + progress * (settings.last_share - settings.first_share)
  return Mixture(teacher, progress * settings.belief_share)


def may_collect(settings: DistillSettings, frames: int, *, begun: int | None) -> bool:
  """Whether a further episode is wanted: the data set has room, and room is left for the students.

  Args:
    settings: of the distillation.
    frames: of the run so far.
    begun: frames at which the run's first own student was there; None before it.
  """
  limit = settings.max_frames
  return frames < (min(limit, settings.teacher_frames) if begun is None else limit)


def push_level(settings: DistillSettings, frames: int) -> tuple[float, float]:
  """Returns the range of pushes' forces [N] after a number of frames."""
  return [(low, high) for first, low, high in settings.push_forces if frames >= first][-1]


def pushed(environment: str, forces: tuple[float, float]) -> str:
  """Returns an environment's name with pushes of these forces [N], or with none."""
  if forces[1] < _NO_PUSH:
    return with_options(environment, {"pushes": "false"})
  return with_options(environment, {"pushes": "true", "push_force": f"{forces[0]},{forces[1]}"})
