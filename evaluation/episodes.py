"""What is kept of an evaluation: one line of JSON for each episode, appended as it ends."""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from nerf2real.core import files
from nerf2real.core.serialization import from_plain, to_plain

SUCCESS, COLLISION, FALL, LOST, STOPPED = "success", "collision", "fall", "lost", "stopped"
OUTCOMES = (SUCCESS, COLLISION, FALL, LOST, STOPPED)
FILE = "episodes.jsonl"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
  """What an episode belongs to; episodes of one setting are counted together."""

  policy: str
  """Its name."""
  policy_id: str
  """Digest of its parameters."""
  resolution: str
  """Of its pictures, such as "30 x 40"; "no camera"."""
  plant: str
  """"sim", "virtual" or "robot"."""
  plant_id: str
  """Which robot: the virtual one's seed, the robot's name."""
  protocol: str
  """"navigation", "ball" or "gain"."""
  perturbation: str
  """"none", or what was disturbed."""
  control: str = "none"
  """Or what of the observations was falsified, one of `controls.CONTROLS`."""
  conditions: str = ""
  """What else is not as in the paper's evaluation in the built-in room, such as another scene;
  see `plants.plant.conditions_of`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moment:
  """A policy's belief at one step."""

  time: float
  """s."""
  position: tuple[float, float] | None
  """True x, y [m]."""
  logits: list[float]
  """[M]."""
  means: list[list[float]]
  """[M, 3] m, m, rad."""
  stddevs: list[list[float]]
  """[M, 3]."""
  picture: str = ""
  """What it saw, PNG in base64."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Episode:
  """One episode."""

  setting: Setting
  group: str
  """Within a protocol: "navigation", "center", "wall", "gain 50"."""
  index: int
  """Of the trial in the protocol."""
  goal: tuple[float, float]
  """m."""
  outcome: str
  """One of OUTCOMES."""
  detail: str = ""
  """More about why it ended."""
  time: float | None = None
  """s until the goal was reached."""
  duration: float = 0.0
  """s."""
  localisation_error: float | None = None
  """m, mean over the episode."""
  path: list[list[float]] = dataclasses.field(default_factory=list)
  """[t, x, y, yaw] every 0.2 s."""
  ball_path: list[list[float]] = dataclasses.field(default_factory=list)
  """[t, x, y]."""
  moments: list[Moment] = dataclasses.field(default_factory=list)

  @property
  def success(self) -> bool:
    """Whether the goal was reached as the paper counts it."""
    return self.outcome == SUCCESS

  @property
  def key(self) -> tuple[Any, ...]:
    """The identity of an episode: an evaluation runs each once."""
    return (*dataclasses.astuple(self.setting), self.index)


class Store:
  """The episodes of an evaluation's folder; of two of one trial the first counts."""

  def __init__(self, folder: Path):
    """Opens a folder, and reads what earlier runs left.

    Raises:
      ValueError: A line is damaged that was not cut off at the file's end.
    """
    self.path = Path(folder) / FILE
    self.path.parent.mkdir(parents=True, exist_ok=True)
    self.read()

  def read(self) -> None:
    """Reads the folder, also anew after other processes wrote into it."""
    self.episodes: list[Episode] = []
    self.duplicates = 0  # episodes that were left out
    if self.path.exists():
      self._read(self.path.read_text())

  def _read(self, text: str) -> None:
    lines, keys = text.splitlines(), self.done()
    cut_off = not text.endswith("\n")
    for number, line in enumerate(lines):
      try:
        episode = from_plain(json.loads(line), Episode)
      except ValueError as error:
        if cut_off and number == len(lines) - 1:  # while the run wrote: that episode is rerun
          kept = "".join(f"{whole}\n" for whole in lines[:-1])
          files.write_atomically(self.path, kept)
          return
        raise ValueError(
          f"{self.path}, line {number + 1} is damaged ({error}): remove that line, its episode is "
          "run again."
        ) from error
      if episode.key in keys:  # two processes wrote into the folder: counted once
        self.duplicates += 1
        continue
      keys.add(episode.key)
      self.episodes.append(episode)
    if text and cut_off:
      files.write_atomically(self.path, text + "\n")

  def done(self) -> set[tuple[Any, ...]]:
    """Returns the keys of the episodes that are there."""
    return {episode.key for episode in self.episodes}

  def add(self, episode: Episode) -> None:
    """Keeps an episode."""
    files.append_line(self.path, json.dumps(to_plain(episode)))
    self.episodes.append(episode)


def select(episodes: Iterable[Episode], **wanted: str) -> list[Episode]:
  """Returns the episodes whose setting, or group, has these values."""
  return [
    episode
    for episode in episodes
    if all(
      (episode.group if name == "group" else getattr(episode.setting, name)) == value
      for name, value in wanted.items()
    )
  ]
