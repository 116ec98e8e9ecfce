"""Command-line arguments that all processes of a run share."""

import argparse
from pathlib import Path

from nerf2real.agents.link.sessions import LinkSettings, Security


def add_link_arguments(parser: argparse.ArgumentParser, *, side: str) -> None:
  """Adds the link's arguments; side is "learner", "router" or "actor"."""
  group = parser.add_argument_group("link")
  group.add_argument("--prefix", default=LinkSettings.prefix, help="first part of every key")
  group.add_argument(
    "--lease",
    type=float,
    default=LinkSettings.lease,
    help="time after which a silent peer counts as gone [s]",
  )
  group.add_argument(
    "--no-shared-memory", action="store_true", help="pass large messages through the socket"
  )
  if side in ("learner", "router"):
    group.add_argument("--users", type=Path, help="file of lines user:password; only these join")
    group.add_argument("--tls-certificate", type=Path, help="certificate for tls/ endpoints [PEM]")
    group.add_argument("--tls-key", type=Path, help="the certificate's private key [PEM]")
    group.add_argument(
      "--allow-anonymous", action="store_true", help="listen beyond this machine without users"
    )
  if side in ("learner", "actor"):
    group.add_argument("--login", type=Path, help="file with one line user:password")
    group.add_argument(
      "--tls-authority", type=Path, help="certificate of the learner's signing authority [PEM]"
    )


def link_settings(arguments: argparse.Namespace) -> LinkSettings:
  """Reads the settings from parsed arguments."""
  names = ("users", "login", "tls_certificate", "tls_key", "tls_authority", "allow_anonymous")
  security = {name: value for name in names if (value := getattr(arguments, name, None))}
  return LinkSettings(
    security=Security(**security),
    prefix=arguments.prefix,
    lease=arguments.lease,
    shared_memory=not arguments.no_shared_memory,
  )
