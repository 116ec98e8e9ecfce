"""A policy watched: episodes of any policy as a film, with a line for every goal it reaches.

  python examples/watch_policy.py --policy walker --seconds 10 --out out/walk.mp4

In the browser instead: `python launch/view.py --task nerf_nav --policy walker`.
"""

import argparse
import pathlib

from nerf2real.evaluation.policies.driving import choose_driver
from nerf2real.suite.views.rollout import run_episodes


def main() -> None:
  """Films."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--policy", default="walker", help="walker, shipped, or a folder")
  parser.add_argument("--seconds", type=float, default=10.0)
  parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/walk.mp4"))
  arguments = parser.parse_args()
  chosen = choose_driver(arguments.policy, task="nerf_nav")
  lines = run_episodes(
    "nerf_nav",
    driver=chosen.make,
    image_size=chosen.image_size or (30, 40),
    camera=chosen.camera,
    seconds=arguments.seconds,
    seed=3,
    video=arguments.out,
  )
  print("\n".join(lines or ["no goal reached yet"]))
  print(f"wrote {arguments.out}")


if __name__ == "__main__":
  main()
