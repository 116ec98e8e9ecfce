"""Who may do what on the link: the file of users, and the rules that a router enforces."""

from pathlib import Path
from typing import Any


class LinkError(RuntimeError):
  """A session could not be opened; the message is one line for the user."""


def read_users(path: Path) -> dict[str, str]:
  """Reads lines `user:password`; raises LinkError for a file without any, or with others."""
  try:
    lines = [line.strip() for line in path.read_text().splitlines()]
  except OSError as error:
    raise LinkError(f"Cannot read the users in {path}: {error.strerror}.") from error
  users = {}
  for line in filter(None, lines):
    user, colon, password = line.partition(":")
    if not colon or not user or not password:
      raise LinkError(f"{path}: every line must read user:password.")
    users[user] = password
  if not users:
    raise LinkError(f"{path} holds no line user:password.")
  return users


def access_control(users: list[str], prefix: str, *, learner: str | None) -> dict[str, Any]:
  """The router's rules: actors put trajectories and metrics, query, and declare their liveliness.

  No actor can answer queries in the learner's place or publish on its keys.

  Args:
    users: names that may join.
    prefix: first part of every key.
    learner: the one of them that joins as the learner and may do all below the prefix; None where
      the learner itself is the router, so that every user is an actor's.
  """
  inward = ["put", "query", "liveliness_token", "liveliness_query"]
  inward.append("declare_liveliness_subscriber")
  rules: list[dict[str, Any]] = [
    {
      "id": "from actors",
      "permission": "allow",
      "flows": ["ingress"],
      "messages": inward,
      "key_exprs": [f"{prefix}/{k}/**" for k in ("trajectory", "metrics", "ask", "alive")],
    },
    {
      "id": "to actors",
      "permission": "allow",
      "flows": ["egress"],
      "messages": [
        "reply",
        "declare_queryable",
        "declare_subscriber",
        "liveliness_token",
        "declare_liveliness_subscriber",
      ],
      "key_exprs": [f"{prefix}/**"],
    },
  ]
  subjects = [{"id": "actors", "usernames": sorted(set(users) - {learner})}]
  policies = [{"rules": ["from actors", "to actors"], "subjects": ["actors"]}]
  if not subjects[0]["usernames"]:
    raise LinkError(
      f"Only the learner's user {learner!r} is given: add a line for the actors' user, so that "
      "they do not share the learner's rights."
    )
  if learner is not None:
    rules.append(
      {
        "id": "learner",
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": [
          "put",
          "query",
          "reply",
          "declare_queryable",
          "declare_subscriber",
          "liveliness_token",
          "liveliness_query",
          "declare_liveliness_subscriber",
        ],
        "key_exprs": [f"{prefix}/**"],
      }
    )
    subjects.append({"id": "learner", "usernames": [learner]})
    policies.append({"rules": ["learner"], "subjects": ["learner"]})
  return {
    "enabled": True,
    "default_permission": "deny",
    "rules": rules,
    "subjects": subjects,
    "policies": policies,
  }
