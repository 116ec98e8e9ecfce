"""The figures of a run while it runs, fetched from its learner: as a table, and as a line."""

import os
import time
from typing import Any

from rich.table import Table

from nerf2real.agents.link import sessions
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError

_SILENT = 5.0  # s without an answer until that is shown


class StatusView:
  """Fetches the learner's status and formats it."""

  def __init__(self, title: str, endpoint: str, settings: sessions.LinkSettings):
    """Connects with the first `refresh` that finds a learner or a router.

    Args:
      title: of the table.
      endpoint: the learner's, or the router's.
      settings: the link's settings, with a login of the run.
    """
    self._title, self._endpoint, self._settings = title, endpoint, settings
    self._link: ActorLink | None = None
    self._answered = time.monotonic()
    self.status: dict[str, Any] = {}

  @property
  def problem(self) -> str:
    """What the learner could not write, such as a checkpoint on a full disk; empty if nothing."""
    return str(self.status.get("problem") or "")

  def refresh(self) -> None:
    """Fetches the status once; the last one stays while the learner does not answer."""
    try:
      if self._link is None:
        session = sessions.connect(self._endpoint, self._settings, timeout=0)
        name = f"viewer-{os.getpid()}"
        self._link = ActorLink(session, self._settings, actor=name, role="viewer", ask_timeout=1.0)
      answer = self._link.status()
    except (sessions.LinkError, MessageError):
      return
    if answer is not None and answer["status"].get("steps") is not None:
      self.status, self._answered = answer["status"], time.monotonic()

  def close(self) -> None:
    """Leaves the run."""
    if self._link is not None:
      self._link.close()

  def table(self, *, restarts: int, waiting: list[str]) -> Table:
    """Returns the status as a table.

    Args:
      restarts: of the run's processes.
      waiting: names of processes that wait for a free machine.
    """
    s, table = self.status, Table(title=self._title, box=None)
    table.add_column(justify="right", style="cyan")
    table.add_column()
    rows = {} if s else {"": "starting"}
    if s:
      rows = {
        "steps": f"{s['steps']:,} ({s['steps_per_second']:.0f}/s)",
        "updates": f"{s['updates']:,} ({s['updates_per_second']:.1f}/s)"
        + "".join(f", {text}" for text in _before(s)),
        **_returns(s),
        "success": _number(s["success"]),
        "localisation error": _number(s["localisation_error"]) + " m",
        "replay": f"{s['replay_steps']:,} steps",
        "link": f"queue {s['queue']}, dropped {s['dropped']}, refused {s['refused']}, "
        f"sent again {s['duplicates']}",
        "parameters": f"{s['parameters_age']:.1f} s old, version {s['parameters_version']}, "
        f"actors at most {s['parameters_lag']} updates behind",
        "processes": f"{s['actors']} actors alive, {restarts} restarts",
      }
      silence = time.monotonic() - self._answered
      if silence > _SILENT:
        rows["learner"] = f"silent for {silence:.0f} s"
      if self.problem:
        rows["problem"] = self.problem
    if waiting:
      rows["no free machine"] = ", ".join(waiting)
    for name, text in rows.items():
      table.add_row(name, text)
    return table

  def line(self, *, waiting: list[str]) -> str:
    """Returns the main figures in one line, for a log."""
    s = self.status
    parts = []
    if s:
      parts = [
        f"steps {s['steps']:,} ({s['steps_per_second']:.0f}/s)",
        f"updates {s['updates']:,} ({s['updates_per_second']:.1f}/s)",
        *_before(s),
        *(f"{n} {s[n]:.3g}" for n in ("return", "evaluation", "success") if s.get(n) is not None),
        f"{s['actors']} actors",
        f"dropped {s['dropped']}",
      ]
    if waiting:
      parts.append(f"waiting for free CPUs: {', '.join(waiting)}")
    if self.problem:
      parts.append(self.problem)
    return ", ".join(parts) or "starting"


def _before(status: dict[str, Any]) -> list[str]:
  """What is done before the first update: what the learner says, or how far the replay is."""
  if status.get("doing") or status["filled"]:
    return [status["doing"]] if status.get("doing") else []
  needed = status.get("replay_needed")
  of = "" if needed is None else f" of {needed:,}"
  return [f"filling the replay: {status['replay_steps']:,}{of}"]


def _returns(status: dict[str, Any]) -> dict[str, str]:
  """The row of returns; none for a run without returns, such as a distillation."""
  if "return" not in status:
    return {}
  acting, evaluated, best = (_number(status[n]) for n in ("return", "evaluation", "best"))
  return {"return": f"{acting} acting, {evaluated} evaluated, best {best}"}


def _number(value: float | None) -> str:
  return "-" if value is None else f"{value:.3g}"
