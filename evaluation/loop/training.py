"""Trains a policy on by distillation, with effects drawn from their intervals every episode."""

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from nerf2real.agents.distill import settings as distillation
from nerf2real.agents.distill.learning.checkpoint import STATE, load_counters
from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.environments.loading import with_options
from nerf2real.agents.supervision import training
from nerf2real.evaluation.loop.settings import AUTO, LoopSettings
from nerf2real.evaluation.loop.teachers import choose_teacher

POLICY = Path("policy") / "newest"
_DONE = 0.99  # of the minutes, from which a training is taken for finished


class Trained(NamedTuple):
  """A policy that was trained on."""

  policy: Path  # folder of the export
  teacher: str
  teachers: dict[str, int]  # successes of each walker with the effects, of `trials`
  trials: int
  minutes: float  # of training
  frames: int  # collected
  updates: int  # of the student; few in many minutes: the machine had other work


def environment_name(settings: LoopSettings, policy: Path | None, effects: Path) -> str:
  """Returns the policy's environment, or the preset's, with effects from their intervals."""
  own = distillation.preset(settings.preset).environment
  if policy is not None:
    own = str(export.read_record(policy)["environment"])
  options = {"effects": str(effects), "draw_effects": "true"}
  if settings.scene is not None:
    options["scene"] = str(settings.scene)
  return with_options(own, options)


def train(
  settings: LoopSettings,
  policy: Path | None,
  effects: Path,
  *,
  scene: Any,
  scripts: training.Scripts,
) -> Trained:
  """Trains a policy on, or goes on with that.

  Args:
    settings: The loop's.
    policy: The student begins with it; None: with random weights.
    effects: effects.json, drawn from its intervals.
    scene: The bundle.
    scripts: Of learner and collectors.

  Raises:
    RuntimeError: The training failed or was stopped; the same loop goes on with it.
  """
  run = settings.out / "training"
  run.mkdir(parents=True, exist_ok=True)
  teacher, teachers, count = settings.teacher, dict[str, int](), 0
  if teacher == AUTO:
    teacher, teachers, count = choose_teacher(
      run, effects, scene, seed=settings.seed, time_limit=settings.time_limit
    )
  if _minutes(run) < _DONE * settings.minutes:
    forwarded = ["--minutes", str(settings.minutes), "--teacher", teacher]
    if policy is not None:
      forwarded += ["--init-from", str(policy)]
    arguments = training.TrainingSettings(
      env=environment_name(settings, policy, effects.resolve()),
      actors=settings.actors,
      run=run,
      preset=settings.preset,
      seed=settings.seed,
      resume=(run / STATE).exists(),
      evaluator=False,
    )
    with _signals_kept():
      failure = training.train(arguments, scripts, forwarded=forwarded, command="close_loop")
    if failure:
      raise RuntimeError(f"The training failed: {failure}")
    if _minutes(run) < _DONE * settings.minutes:
      raise RuntimeError(
        f"The training ended after {_minutes(run):.1f} of {settings.minutes:g} minutes: the same "
        "command goes on with it."
      )
  if not (run / POLICY / export.RECORD).exists():
    raise RuntimeError(
      f"The training gave no policy in {_minutes(run):.1f} minutes, too few for a first student: "
      f"the same command with more than --minutes {settings.minutes:g} goes on with it."
    )
  info = export.read_record(run / POLICY)["info"]
  frames, updates = int(info["steps"]), int(info["updates"])
  return Trained(run / POLICY, teacher, teachers, count, _minutes(run), frames, updates)


@contextlib.contextmanager
def _signals_kept() -> Iterator[None]:
  """Puts the handlers of Ctrl-C and SIGTERM back, which a supervised run replaces."""
  kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
  try:
    yield
  finally:
    for number, handler in kept.items():
      signal.signal(number, handler)


def _minutes(run: Path) -> float:
  """Returns the minutes that a distillation has trained; 0 before its first saved state."""
  return load_counters(run / STATE).elapsed / 60 if (run / STATE).exists() else 0.0
