"""Starts the learner of a distillation, which owns its data set and the student.

  python launch/distill_learner.py --run runs/walk --preset nerf_nav --minutes 120

Listens on this machine only, unless --listen names another address; then --users is needed.
Collectors join with `launch/actor.py --connect`.
"""

import dataclasses
import logging
import signal
import sys
from pathlib import Path
from typing import Any

import tyro

from nerf2real.agents.link import sessions
from nerf2real.agents.supervision.statuses import NOT_SAVED
from nerf2real.core.files import is_disk_full
from nerf2real.core.serialization import read_json
from nerf2real.launch import command
from nerf2real.launch.learner import DEFAULT_ENDPOINT, set_threads

_ENVIRONMENT = {**command.NOT_DRAWING, **command.ONE_THREAD}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Starts the learner of a distillation."""

  run: Path
  """The run's folder."""
  listen: str = DEFAULT_ENDPOINT
  """Where to listen, such as tcp/0.0.0.0:7447."""
  preset: str = "nerf_nav"
  """Settings to start from: nerf_nav, nerf_nav_60x80, ball_push; adapt, nerf_nav_on,
  nerf_nav_faster or, for ball pushing, ball_push_on to train a policy on, room to do so in another
  room; or tiny to try the machinery."""
  env: str | None = None
  """Where, such as "suite:nerf_nav?scene=out/room"; the preset's if not given."""
  teacher: str | None = None
  """quick, swift, brisk, nimble, steady, tall, ball, a walker's settings as JSON, or an exported
  policy's folder; the preset's if not given."""
  init_from: Path | None = None
  """Folder of an exported policy that the student begins with; its networks are taken along."""
  view_scenes: tuple[Path, ...] = ()
  """Other reconstructions of the same room (another quality, another film), from one marker: where
  the preset has views, they are rendered in these, too, so that the encoder learns the room and not
  one field's flaws."""
  relabel: Path | None = None
  """Folder `data` of an earlier run in such an environment: a new run begins with its episodes,
  labelled by the teacher of now. They count among the frames, but the teacher's share falls over
  those that come after the run's own first student."""
  max_env_steps: int | None = None
  """Frames collected at most [steps]; the preset's if not given."""
  minutes: float = 60.0
  """Training time over all parts of the run [min]."""
  keep_minutes: float | None = None
  """Training time between students that are kept in the run's policy/ beside the newest [min]."""
  seed: int | None = None
  """Seed of first weights, augmentation, sampling and, with a collector's number, of its episodes;
  0, or a resumed run's own, if not given."""
  threads: int = 1
  """Processor threads of the updates."""
  resume: bool = False
  """Continue from the last saved state, with the settings that the run began with."""
  link: tyro.conf.OmitArgPrefixes[sessions.LinkSettings] = sessions.LinkSettings()
  """The link's settings."""


def settings_of(arguments: Arguments) -> Any:
  """Returns the settings of a run: the preset's with changes, or those it began with.

  Raises:
    ValueError: The preset is unknown or has no views for the scenes given, a scene is no bundle,
      or there is no policy to begin with.
  """
  from nerf2real.agents.distill import settings
  from nerf2real.agents.distill.learning import beginning
  from nerf2real.suite.scene import open_scene

  if arguments.resume:
    if not (arguments.run / settings.SETTINGS).exists():
      raise ValueError(f"{arguments.run} holds no run to continue: leave --resume out.")
    return read_json(arguments.run / settings.SETTINGS, settings.DistillSettings)
  changes: dict[str, Any] = {
    "environment": arguments.env,
    "teacher": arguments.teacher,
    "max_frames": arguments.max_env_steps,
    "keep_minutes": arguments.keep_minutes,
  }
  if arguments.init_from is not None:
    changes["init_from"] = str(arguments.init_from)
    changes["agent"] = beginning.agent_of(arguments.init_from)
  if arguments.view_scenes:
    for scene in arguments.view_scenes:
      open_scene(scene)
    changes["view_scenes"] = tuple(str(scene) for scene in arguments.view_scenes)
  given = {name: value for name, value in changes.items() if value is not None}
  found = dataclasses.replace(settings.preset(arguments.preset), **given)
  if found.view_scenes and not found.views:
    raise ValueError(
      f"--view-scenes: preset {arguments.preset} has no views; nerf_nav_on, nerf_nav_60x80, "
      "ball_push and ball_push_on have."
    )
  return found


def run(arguments: Arguments) -> None:
  """Distils until the minutes are over or it is stopped.

  Raises:
    CommandError: It cannot start with these arguments, episodes can no longer be taken in, or what
      was learned cannot be saved.
  """
  logging.basicConfig(level=logging.INFO, format="%(asctime)s learner: %(message)s", force=True)
  set_threads(arguments.threads)
  with command.learner_folder(arguments.run):
    _distil(arguments)


def _distil(arguments: Arguments) -> None:
  from nerf2real.agents.distill.learning.checkpoint import STATE
  from nerf2real.agents.distill.learning.learner import Learner
  from nerf2real.agents.distill.relabelling import relabel_for

  try:
    settings = settings_of(arguments)
    sessions.check_listening(arguments.listen, arguments.link)
    if arguments.relabel is not None and not (arguments.run / STATE).exists():
      relabel_for(settings, arguments.relabel, arguments.run / "data", seed=arguments.seed or 0)
    learner = Learner(
      settings,
      arguments.run,
      endpoint=arguments.listen,
      link=arguments.link,
      seed=arguments.seed,
      minutes=arguments.minutes,
      resume=arguments.resume,
    )
  except (ValueError, OSError, sessions.LinkError) as error:
    raise command.RefusedError(error) from error
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: learner.stop())
  try:
    learner.run()
  except RuntimeError as error:
    raise command.CommandError(error) from error
  except OSError as error:  # of a state or a policy: on a full disk a new start fails as well
    status = NOT_SAVED if is_disk_full(error) else command.FAILED
    raise command.CommandError(error, status=status) from error
  finally:
    learner.close()


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=_ENVIRONMENT, errors=())


if __name__ == "__main__":
  sys.exit(main())
