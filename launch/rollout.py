"""Runs episodes of a task and writes a video: third person, the robot's view, the map with a trail.

  python launch/rollout.py --task nerf_nav --video out/nerf_nav.mp4
  python launch/rollout.py --task ball_push --scene out/livingroom --seconds 20
  python launch/rollout.py --policy runs/nav --video out/nav.webp

Where the policy expects itself, if it has a belief, lies over the map.
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
  """Where to write the film (.mp4, or .webp or .gif of half the size); none if not given."""
  policy: str = "walker"
  """What acts: walker, shipped, a run's folder, an exported policy's, stand or random."""
  seconds: float = 10.0
  """Length of the run, over as many episodes as it takes [s]."""
  image_height: int = 60
  """Height of the robot's picture [pixel]; its width is 4/3 of it. A learned policy has its own."""
  effects: Path | None = None
  """An effects.json: what the nominal model lacks."""
  pushes: bool = False
  """Whether the robot is pushed at random, as in training."""
  seed: int = 0
  """Seed of the episodes."""


def run(arguments: Arguments) -> None:
  """Runs the episodes and prints how they ended."""
  from nerf2real.evaluation.policies.driving import choose_driver
  from nerf2real.suite.views.film import check_film
  from nerf2real.suite.views.rollout import run_episodes

  if arguments.video is not None:
    check_film(arguments.video)
  chosen = choose_driver(arguments.policy, task=arguments.task, seed=arguments.seed)
  height = arguments.image_height
  lines = run_episodes(
    arguments.task,
    scene=arguments.scene,
    effects=arguments.effects,
    driver=chosen.make,
    seconds=arguments.seconds,
    image_size=chosen.image_size or (height, height * 4 // 3),
    camera=chosen.camera,
    pushes=arguments.pushes,
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
