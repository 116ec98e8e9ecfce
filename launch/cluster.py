"""Trains on several machines: processes placed by Ray, data over zenoh.

  python launch/cluster.py --env suite:nerf_nav --actors 30 --run /shared/runs/x

Run it on the head of a Ray cluster (`ray start --head` there, `ray start --address HEAD:6379` on
the others). Ray places the same processes that `launch/local_distributed.py` starts, and places
them again when a machine is lost; data travels over zenoh through a router in this script. Every
machine needs this checkout at the same path and the project installed. The run's folder must be
seen by every machine that may get the learner (a shared disk); --learner-resource pins it to one.
Ctrl-C ends the run with a checkpoint; --resume goes on. Arguments that are not listed here go to
the learner (`launch/learner.py --help`). Needs the extra `cluster`.
"""

import dataclasses
import sys

from nerf2real.agents.supervision import cluster
from nerf2real.launch import command
from nerf2real.launch.local_distributed import SCRIPTS, supervised


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments(cluster.ClusterSettings):
  """Trains on several machines."""


def run(arguments: Arguments, forwarded: list[str]) -> None:
  """Trains; forwards arguments to the learner.

  Raises:
    CommandError: The run cannot start, or it failed.
  """
  supervised(cluster.train, arguments, SCRIPTS, forwarded)


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, errors=(OSError,), forwards=True)


if __name__ == "__main__":
  sys.exit(main())
