"""zenoh sessions: what listens, who may join, and the settings that keep a stalled link lossless.

Nothing is scouted for and nothing listens beyond this machine by default. Why each setting is as
it is stands beside it; the figures were measured with eclipse-zenoh 1.10.
"""

import dataclasses
import ipaddress
import json
import logging
import re
import socket
import time
from pathlib import Path
from typing import Any

import zenoh

from nerf2real.agents.link.access import LinkError, access_control, read_users

_log = logging.getLogger(__name__)

# With congestion control BLOCK a put waits this long for a stalled receiver before it closes the
# transport, after which puts vanish. The default of 5 s is shorter than a compilation.
_WAIT_BEFORE_CLOSE_MICROSECONDS = 120_000_000
_SHARED_MEMORY_BYTES = 64 << 20  # pool of a process; 16 MiB holds too few trajectories
_OPEN_TIMEOUT_MS = 3000
_ATTEMPT_MS = 1500  # of one attempt to join; `connect` tries again until its own timeout
_TCP = ("tcp", "tls", "ws", "wss")  # kinds of endpoints that a port of TCP stands behind
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Security:
  """Who may join, and how the line is protected."""

  users: Path | None = None
  """Learner's side: file of lines `user:password`; only these may join."""
  login: Path | None = None
  """Actor's side: file with one line `user:password`."""
  tls_certificate: Path | None = None
  """Learner's side: certificate in PEM."""
  tls_key: Path | None = None
  """Learner's side: the certificate's private key in PEM."""
  tls_authority: Path | None = None
  """Actor's side: certificate of the authority that signed the learner's, in PEM."""
  allow_anonymous: bool = False
  """Listen beyond this machine without users; for networks that are closed by other means."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinkSettings:
  """Settings of a session."""

  security: Security = Security()
  """Who may join."""
  prefix: str = "nerf2real"
  """First part of every key; two runs on one router need two."""
  lease: float = 10.0
  """Time after which a silent peer counts as gone [s]; zenoh's default."""
  shared_memory: bool = True
  """Whether processes of one machine pass large messages through shared memory."""


def listen(endpoint: str, settings: LinkSettings) -> zenoh.Session:
  """Opens the learner's session, which routes between all others.

  Args:
    endpoint: such as tcp/127.0.0.1:7447 or tls/0.0.0.0:7447.
    settings: the link's settings.

  Raises:
    LinkError: if the endpoint is open to the network without users, or is taken.
  """
  return _open_router(endpoint, settings, learner_joins=False)


def check_listening(endpoint: str, settings: LinkSettings) -> None:
  """Checks that `listen` can be called: what takes minutes to prepare must not end in a taken port.

  The port is bound and left at once, without a session: no actor may join what is gone again.

  Raises:
    LinkError: as `listen`.
  """
  _router_config(endpoint, settings, learner_joins=False)
  kind, _, place = re.split("[?#]", endpoint, maxsplit=1)[0].partition("/")
  host, _, port = place.rpartition(":")
  if kind not in _TCP or not port.isdecimal():
    return
  try:
    family, _, _, _, address = socket.getaddrinfo(
      host.strip("[]"), int(port), type=socket.SOCK_STREAM
    )[0]
    with socket.socket(family, socket.SOCK_STREAM) as probe:
      probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as zenoh: not for ended links
      probe.bind(address)
  except OSError as error:
    raise LinkError(f"Cannot listen on {endpoint}: {error.strerror}.") from error


def route(endpoint: str, settings: LinkSettings) -> zenoh.Session:
  """Opens a router that the learner joins as well: its address stays while the learner moves.

  Args:
    endpoint: such as tcp/0.0.0.0:7447.
    settings: the link's settings; the first of the users is the learner's, and may do all.

  Raises:
    LinkError: as `listen`.
  """
  return _open_router(endpoint, settings, learner_joins=True)


def _open_router(endpoint: str, settings: LinkSettings, *, learner_joins: bool) -> zenoh.Session:
  config = _router_config(endpoint, settings, learner_joins=learner_joins)
  try:
    return zenoh.open(config)
  except zenoh.ZError as error:
    raise LinkError(f"Cannot listen on {endpoint}: {_first_line(error)}") from error


def _router_config(endpoint: str, settings: LinkSettings, *, learner_joins: bool) -> zenoh.Config:
  security = settings.security
  if not is_loopback(endpoint) and security.users is None and not security.allow_anonymous:
    raise LinkError(
      f"{endpoint} can be reached from other machines and no users are set: give a file of "
      "user:password lines (--users), or say that anyone may join (--allow-anonymous)."
    )
  config = _common(settings)
  _insert(config, "mode", "router")
  _insert_endpoint(config, "listen/endpoints", endpoint)
  _insert(config, "listen/exit_on_failure", True)
  if security.users is not None:
    users = read_users(security.users)
    _insert(config, "transport/auth/usrpwd/dictionary_file", str(security.users))
    own, password = next(iter(users.items()))
    _insert(config, "transport/auth/usrpwd/user", own)
    _insert(config, "transport/auth/usrpwd/password", password)
    rules = access_control(list(users), settings.prefix, learner=own if learner_joins else None)
    _insert(config, "access_control", rules)
  if endpoint.startswith("tls/"):
    if security.tls_certificate is None or security.tls_key is None:
      raise LinkError(f"{endpoint} needs a certificate and its key (--tls-certificate, --tls-key).")
    _insert(config, "transport/link/tls/listen_certificate", str(security.tls_certificate))
    _insert(config, "transport/link/tls/listen_private_key", str(security.tls_key))
  return config


def connect(endpoint: str, settings: LinkSettings, *, timeout: float) -> zenoh.Session:
  """Opens a session of an actor, the evaluator, or a learner that joins a router of its own.

  It reconnects by itself later on.

  Raises:
    LinkError: if nothing answers within `timeout` seconds, or the login is refused.
  """
  security = settings.security
  config = _common(settings)
  _insert(config, "mode", "client")
  _insert_endpoint(config, "connect/endpoints", endpoint)
  _insert(config, "connect/timeout_ms", _ATTEMPT_MS)
  _insert(config, "connect/exit_on_failure", True)
  _insert(config, "connect/retry", _RETRY)
  _insert(config, "listen/endpoints", [])
  if security.login is not None:
    (user, password), *_ = read_users(security.login).items()
    _insert(config, "transport/auth/usrpwd/user", user)
    _insert(config, "transport/auth/usrpwd/password", password)
  if security.tls_authority is not None:
    _insert(config, "transport/link/tls/root_ca_certificate", str(security.tls_authority))
  deadline = time.monotonic() + timeout
  while True:
    try:
      return zenoh.open(config)
    except zenoh.ZError as error:
      if time.monotonic() >= deadline:
        raise LinkError(
          f"Cannot join {endpoint} within {timeout:g} s: no learner listens there, or it refused "
          f"the user or the password ({_first_line(error)})."
        ) from error
    time.sleep(0.2)


def close(session: zenoh.Session) -> None:
  """Closes a session; one whose peer is stalled is left to close by itself."""
  try:
    session.close()
  except zenoh.ZError as error:
    _log.warning("The link was not closed in order: %s", _first_line(error))


def is_loopback(endpoint: str) -> bool:
  """Whether an endpoint such as tcp/127.0.0.1:7447 is reached from this machine only."""
  host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
  if host == "localhost":
    return True
  try:
    return ipaddress.ip_address(host).is_loopback
  except ValueError:
    return False


def _insert_endpoint(config: zenoh.Config, key: str, endpoint: str) -> None:
  try:
    _insert(config, key, [endpoint])
  except zenoh.ZError as error:
    raise LinkError(
      f"{endpoint!r} is no endpoint: expected such as tcp/127.0.0.1:7447 or tls/head:7447."
    ) from error


def _common(settings: LinkSettings) -> zenoh.Config:
  config = zenoh.Config()
  _insert(config, "scouting/multicast/enabled", False)
  _insert(config, "scouting/gossip/enabled", False)
  _insert(config, "transport/link/tx/lease", round(1000 * settings.lease))
  _insert(config, "transport/unicast/open_timeout", _OPEN_TIMEOUT_MS)
  wait = "transport/link/tx/queue/congestion_control/block/wait_before_close"
  _insert(config, wait, _WAIT_BEFORE_CLOSE_MICROSECONDS)
  _insert(config, "transport/shared_memory/enabled", settings.shared_memory)
  if settings.shared_memory:
    optimisation = "transport/shared_memory/transport_optimization"
    _insert(config, f"{optimisation}/pool_size", _SHARED_MEMORY_BYTES)
    # Queries stay off shared memory: a reply must not depend on a pool that is full.
    _insert(config, f"{optimisation}/messages", ["put"])
  return config


def _insert(config: zenoh.Config, key: str, value: Any) -> None:
  config.insert_json5(key, json.dumps(value))


def _first_line(error: Exception) -> str:
  return str(error).splitlines()[0][:300]
