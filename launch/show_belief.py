"""Draws where a policy expects to be, over an episode.

  python launch/show_belief.py shipped
  python launch/show_belief.py runs/nav/policy/newest

Runs an episode of the policy's environment with its mean action and draws, at moments spread over
the episode, what the robot sees beside the belief over the room's free floor: white X where it is,
green triangle the goal. Prints the distance between the belief's mean and the truth.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from nerf2real.launch import command


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Draws where a policy expects to be, over an episode."""

  policy: Annotated[str, tyro.conf.Positional]
  """Folder of an exported policy, "shipped" or "shipped_60x80": those of navigation."""
  env: str | None = None
  """Another environment than the one that it was trained on."""
  seed: int = 0
  """Seed of the episode."""
  moments: int = 8
  """How many moments are drawn."""
  max_steps: int = 1200
  """Longest episode [steps]."""
  out: Path = Path("out/belief.png")
  """The picture to write."""


def run(arguments: Arguments) -> None:
  """Draws, writes the picture and prints the errors."""
  import cv2
  import numpy as np

  from nerf2real.core.files import check_writable, write_atomically
  from nerf2real.evaluation.policies.names import SHIPPED, policy_folder
  from nerf2real.evaluation.report.belief_pictures import draw_episode

  if not cv2.haveImageWriter(str(arguments.out)):
    raise ValueError(f"{arguments.out} is no name of a picture: expected one such as belief.png.")
  if arguments.out.parent.exists():  # else it is made when there is a picture
    check_writable(arguments.out)
  name = arguments.policy
  drawn = draw_episode(
    policy_folder(name, task="nerf_nav") if name.startswith(SHIPPED) else Path(name),
    environment=arguments.env,
    seed=arguments.seed,
    moments=arguments.moments,
    max_steps=arguments.max_steps,
  )
  arguments.out.parent.mkdir(parents=True, exist_ok=True)
  _, data = cv2.imencode(arguments.out.suffix, drawn.picture[..., ::-1])
  write_atomically(arguments.out, data.tobytes())
  print(
    f"{len(drawn.errors)} steps, mean distance of the belief from the truth "
    f"{np.mean(drawn.errors):.2f} m, at the end {drawn.errors[-1]:.2f} m: {arguments.out}"
  )


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=command.NOT_DRAWING | command.ONE_THREAD)


if __name__ == "__main__":
  sys.exit(main())
