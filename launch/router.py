"""Starts a router for a run on several machines: `python launch/router.py --users users.txt`.

The learner (`launch/learner.py --connect`) and the actors (`launch/actor.py --connect`) join it,
so that their common address stays the same where the learner is restarted on another machine. The
first line of the users' file is the learner's; the others may only do what actors do.
"""

import argparse
import signal
import sys
import threading

from nerf2real.agents.link import sessions
from nerf2real.agents.link.access import LinkError
from nerf2real.agents.link.arguments import add_link_arguments, link_settings


def main() -> int:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawTextHelpFormatter
  )
  parser.add_argument("--listen", default="tcp/127.0.0.1:7447", help="such as tcp/0.0.0.0:7447")
  add_link_arguments(parser, side="router")
  arguments = parser.parse_args()
  stopped = threading.Event()
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: stopped.set())
  try:
    session = sessions.route(arguments.listen, link_settings(arguments))
  except LinkError as error:
    print(f"error: {error}", file=sys.stderr)
    return 2
  print(f"Routing at {arguments.listen}.", flush=True)
  stopped.wait()
  sessions.close(session)
  return 0


if __name__ == "__main__":
  sys.exit(main())
