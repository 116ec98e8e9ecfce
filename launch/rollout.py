"""Runs episodes of a task and writes a video: third person, the robot's view, the map with a trail.

python launch/rollout.py --task nerf_nav --video out.mp4
python launch/rollout.py --task ball_push --scene out/livingroom --policy random --seconds 20
"""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

from nerf2real.launch import command


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Runs episodes of a task and writes a video."""

  task: Literal["nerf_nav", "ball_push"] = "nerf_nav"
  """Task."""
  scene: Path | None = None
  """Folder of a scene bundle; the built-in room if not given."""
  video: Path | None = None
  """Where to write the video (.mp4); none is written if not given."""
  policy: Literal["stand", "random"] = "stand"
  """What the robot does: hold the reference pose, or random motions about it."""
  seconds: float = 10.0
  """Length of the run, over as many episodes as it takes [s]."""
  image_height: int = 60
  """Height of the robot's picture [pixel]; its width is 4/3 of it."""
  effects: Path | None = None
  """An effects.json: what the nominal model lacks."""
  seed: int = 0
  """Seed of the episodes."""


def run(arguments: Arguments) -> None:
  """Runs the episodes and prints how they ended."""
  from nerf2real.suite.views.rollout import run_episodes

  lines = run_episodes(
    arguments.task,
    scene=arguments.scene,
    effects=arguments.effects,
    policy=arguments.policy,
    seconds=arguments.seconds,
    image_height=arguments.image_height,
    seed=arguments.seed,
    video=arguments.video,
  )
  for line in lines or [f"no episode ended within {arguments.seconds:g} s"]:
    print(line)
  if arguments.video is not None:
    print(f"wrote {arguments.video}")


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run)


if __name__ == "__main__":
  sys.exit(main())
