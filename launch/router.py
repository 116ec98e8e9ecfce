"""Starts a router for a run on several machines.

  python launch/router.py --users users.txt

The learner (`launch/learner.py --connect`) and the actors (`launch/actor.py --connect`) join it,
so that their common address stays the same where the learner is restarted on another machine. The
first line of the users' file is the learner's; the others may only do what actors do.
"""

import dataclasses
import signal
import sys
import threading

import tyro

from nerf2real.agents.link import sessions
from nerf2real.launch import command


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Starts a router for a run on several machines."""

  listen: str = "tcp/127.0.0.1:7447"
  """Where to listen, such as tcp/0.0.0.0:7447."""
  link: tyro.conf.OmitArgPrefixes[sessions.LinkSettings] = sessions.LinkSettings()
  """The link's settings."""


def run(arguments: Arguments) -> None:
  """Routes until it is stopped."""
  stopped = threading.Event()
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: stopped.set())
  try:
    session = sessions.route(arguments.listen, arguments.link)
  except sessions.LinkError as error:
    raise command.CommandError(error, status=command.WRONG_ARGUMENTS) from error
  print(f"Routing at {arguments.listen}.", flush=True)
  stopped.wait()
  sessions.close(session)


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, errors=())


if __name__ == "__main__":
  sys.exit(main())
