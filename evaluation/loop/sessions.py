"""Sessions of a loop's robots: how long a battery has been in use, and what heat ended."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from nerf2real.core.serialization import read_json, write_json
from nerf2real.evaluation.plants.plant import Plant
from nerf2real.real.safety.monitor import Reason, SafetyError

MOST_COOLED = 9
"""Times that a condition is begun anew with a cool robot; chosen: a joint that stops every sixth
of 54 trials is too weak for all of them."""


class Cooled(NamedTuple):
  """A session that ended because a joint was too hot: it stopped a trial or could not begin one."""

  trials: int  # of the condition that were done by then
  detail: str  # which joint, and its temperature


class Session:
  """How long a condition's robot has been on: its battery goes on where an earlier run stopped."""

  def __init__(self, folder: Path, stem: str):
    """Reads what earlier runs left.

    Args:
      folder: Of the trials' logs.
      stem: The condition as a file's name.
    """
    self._path, self._heat = folder / f"{stem}.json", folder / f"{stem}_heat.json"
    self.seconds = read_json(self._path, float) if self._path.exists() else 0.0
    self.cooled = read_json(self._heat, list[Cooled]) if self._heat.exists() else []
    self._before = self.seconds

  def note(self, seconds: float) -> None:
    """Notes the time of this run so far [s]."""
    self._path.parent.mkdir(parents=True, exist_ok=True)
    self.seconds = self._before + seconds
    write_json(self._path, round(self.seconds, 3))

  def cool(self, ended: Cooled) -> None:
    """Notes that heat ended a session; the next begins with a cool robot and the same battery."""
    self._before = self.seconds
    self.cooled.append(ended)
    write_json(self._heat, self.cooled)


def until_hot(plant: Plant, run: Callable[[], object]) -> str:
  """Runs trials until a joint of a virtual robot is too hot; returns which, or "".

  A person lets a real robot cool: of it no session is begun anew.

  Raises:
    SafetyError: The robot stopped for another reason.
  """
  try:
    run()
  except SafetyError:
    hot = overheated(plant)
    if not hot:
      raise
    return hot
  return ""


def overheated(plant: Plant) -> str:
  """Returns which joint of a virtual robot was so hot that torque was switched off, or ""."""
  stop = getattr(plant.environment, "stop", None)
  if not hasattr(plant, "robot") or stop is None or stop.reason != Reason.TEMPERATURE:
    return ""
  return str(stop.detail)
