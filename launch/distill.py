"""Distils a scripted or privileged teacher into a vision policy, by DAgger, on one machine.

  python launch/distill.py --run runs/walk --preset nerf_nav --minutes 120 --actors 1
  python launch/evaluate.py --policy runs/walk/policy/newest --plant sim --protocol navigation

Learner, collectors and evaluator are supervised processes; those that die are replaced. Ctrl-C ends
the run with its state saved; --resume goes on, also with more --minutes. Arguments that are not
listed here go to the learner (see `launch/distill_learner.py --help`).
"""

import dataclasses
import itertools
import sys
from pathlib import Path

from nerf2real.agents.supervision import training
from nerf2real.launch import command
from nerf2real.launch.local_distributed import supervised

# Arguments that are the learner's alone.
_OF_LEARNER = ("teacher", "init_from", "relabel", "minutes", "keep_minutes")
_HERE = Path(__file__).resolve().parent
SCRIPTS = training.Scripts(learner=_HERE / "distill_learner.py", actor=_HERE / "actor.py")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments(training.TrainingSettings):
  """Distils a teacher into a vision policy."""

  env: str | None = None
  """Where, such as "suite:nerf_nav?scene=out/room"; the preset's if not given."""
  actors: int = 1
  """Number of collectors."""
  max_env_steps: int | None = None
  """Frames collected at most [steps]; the preset's if not given."""
  preset: str | None = None
  """Settings of the distillation: nerf_nav, nerf_nav_60x80, ball_push; adapt, nerf_nav_on,
  nerf_nav_faster or, for ball pushing, ball_push_on to train a policy on, room to train it on in
  another room (all with --init-from); or tiny to try the machinery; "nerf_nav" if not given."""
  teacher: str | None = None
  """quick, swift, brisk, nimble, steady, tall, ball, a walker's settings as JSON, or an exported
  policy's folder; the preset's if not given."""
  init_from: Path | None = None
  """Folder of an exported policy that the student begins with; its networks are taken along."""
  relabel: Path | None = None
  """Folder `data` of an earlier run: a new run begins with its episodes, labelled by the teacher of
  now."""
  minutes: float | None = None
  """Training time over all parts of the run [min]; 60 if not given."""
  keep_minutes: float | None = None
  """Training time between students that are kept in the run's policy/ beside the newest [min]; none
  is if not given."""


def run(arguments: Arguments, forwarded: list[str]) -> None:
  """Distils; forwards arguments to the learner.

  Raises:
    CommandError: The run cannot start, or it failed.
  """
  given = {name: getattr(arguments, name) for name in _OF_LEARNER}
  own = [(f"--{n.replace('_', '-')}", str(v)) for n, v in given.items() if v is not None]
  supervised(training.train, arguments, SCRIPTS, [*itertools.chain(*own), *forwarded])


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, errors=(OSError,), forwards=True)


if __name__ == "__main__":
  sys.exit(main())
