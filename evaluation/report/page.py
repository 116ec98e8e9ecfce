"""The report of an evaluation as one HTML page that opens offline."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from nerf2real.agents.dmpo.policy import belief_plot
from nerf2real.core.floor_map import FloorMap
from nerf2real.core.pages import page
from nerf2real.core.pages.blocks import (
  Block,
  Details,
  Grid,
  Legend,
  Picture,
  Preformatted,
  Table,
  Text,
)
from nerf2real.core.pages.page import Section
from nerf2real.evaluation.episodes import OUTCOMES, Episode, Moment
from nerf2real.evaluation.plants.plant import is_in_scene
from nerf2real.evaluation.report import maps, meanings, tables

_MOMENTS = 5  # shown of an episode's belief
_BELIEF_EPISODES = 4  # shown of a setting
_PATHS_HEIGHT, _BELIEF_HEIGHT = 420, 240  # of maps [pixel]
_WIDE = 8  # columns of a table that is set smaller


def write(
  path: Path,
  found: Sequence[Episode],
  *,
  scene: Any,
  condition: str = "",
  settings: Mapping[str, Any] | None = None,
) -> None:
  """Writes the page.

  Args:
    path: The file.
    found: All episodes.
    scene: The bundle, for the map: paths and beliefs are of the episodes in it.
    condition: What those say of it, `plants.plant.scene_condition`.
    settings: Of the run, shown at the end.
  """
  sections = [_table(table) for table in tables.paper_tables(found)]
  sections.append(_table(tables.outcome_table(found), _OUTCOME_TEXT))
  here = [episode for episode in found if is_in_scene(episode.setting.conditions, condition)]
  sections += _paths(here, maps.draw_floor(scene, height=_PATHS_HEIGHT))
  sections += _beliefs(here, maps.draw_floor(scene, height=_BELIEF_HEIGHT))
  sections.append(_episodes(found))
  sections.append(meanings.section())
  if settings is not None:
    text = json.dumps(dict(settings), indent=1, default=str)
    sections.append(Section("Settings", "", [Details("all settings", [Preformatted(text)])]))
  lead = (
    f"{len(found)} episode{'' if len(found) == 1 else 's'}. "
    "What is called virtual robot is a program behind the robot's wires, "
    "with physics, pictures and faults of its own; no figure marked so is of hardware."
  )
  if len(here) < len(found):
    lead += " The maps show the episodes in the scene of the last command alone."
  origin = page.Origin.of_process()
  page.write(path, page.Page("Evaluation", lead, sections, origin=origin))


_OUTCOME_TEXT = (
  "Collision: a part other than the feet touched the room, a moved object or a person. Fall: "
  "tilted, low, or on the floor. Lost: neither, and not at the goal in time. Stopped: by the "
  "robot's own safety or its operator."
)


def _table(table: tables.Table, text: str = "") -> Section:
  # No line break between a figure and its unit.
  rows = [
    (row.name, *(re.sub(r"(?<=\d) (?=sec|m$)", "\u00a0", cell) for cell in row.cells))
    for row in table.rows
  ]
  return Section(table.title, text, [Table(table.header, rows, small=len(table.header) > _WIDE)])


def _title(episode: Episode) -> str:
  setting = episode.setting
  return (
    f"{setting.policy}, {setting.resolution}, {tables.PLANTS[setting.plant]} "
    f"({setting.plant_id}), {setting.protocol}{tables.changes(setting)}"
  )


def _groups(found: Sequence[Episode]) -> dict[str, list[Episode]]:
  groups: dict[str, list[Episode]] = {}
  for episode in found:
    groups.setdefault(_title(episode), []).append(episode)
  return groups


def _paths(found: Sequence[Episode], floor: FloorMap) -> list[Section]:
  pictures = [
    Picture(maps.draw_paths(floor, chosen), title)
    for title, chosen in _groups(found).items()
    if any(episode.path for episode in chosen)
  ]
  if not pictures:
    return []
  return [
    Section(
      "Where the robot went",
      "Seen from above: light is floor where the robot fits, dark is matter. Black dots are "
      "starts, circles and squares are goals, a coloured dot is where a failure ended, a thin "
      "orange line is the ball.",
      [Legend({name: maps.COLORS[name] for name in OUTCOMES}), Grid(pictures, 2)],
    )
  ]


def _beliefs(found: Sequence[Episode], floor: FloorMap) -> list[Section]:
  blocks: list[Block] = []
  for title, chosen in _groups(found).items():
    believing = [episode for episode in chosen if episode.moments]
    if not believing:
      continue
    cells: list[Block | None] = []
    for episode in _telling(believing):
      count = len(episode.moments)
      shown = np.unique(np.linspace(0, count - 1, min(_MOMENTS, count)).astype(int))
      for index in shown:
        moment = episode.moments[index]
        heat = _draw_belief(moment, episode.goal, floor)
        seen = _decode(moment.picture, heat.shape[1])
        picture = heat if seen is None else np.concatenate([seen, heat])
        text = f"episode {episode.index + 1} ({episode.outcome}), {moment.time:.1f} s"
        cells.append(Picture(picture, text))
      cells += [None] * (_MOMENTS - len(shown))
    blocks += [Text(title), Grid(cells, _MOMENTS)]
  if not blocks:
    return []
  return [
    Section(
      "Where the policy believed to be",
      "What the robot saw, and below it the density of its belief over the floor: white X the "
      "truth, green triangle the goal. Each row is an episode.",
      blocks,
    )
  ]


def _draw_belief(moment: Moment, goal: tuple[float, float], floor: FloorMap) -> np.ndarray:
  mixture = (np.array(part) for part in (moment.logits, moment.means, moment.stddevs))
  truth = None if moment.position is None else np.array(moment.position)
  return belief_plot.draw(floor, *mixture, truth=truth, target=np.array(goal))


def _telling(found: Sequence[Episode]) -> list[Episode]:
  """Returns episodes of every outcome, those with the largest errors first among failures."""
  chosen: list[Episode] = []
  order = sorted(found, key=lambda e: -(e.localisation_error or 0.0))
  for outcome in OUTCOMES:
    chosen += [episode for episode in order if episode.outcome == outcome][:2]
  return chosen[:_BELIEF_EPISODES]


def _decode(picture: str, width: int) -> np.ndarray | None:
  if not picture:
    return None
  data = np.frombuffer(base64.b64decode(picture), np.uint8)
  image: Any = cv2.imdecode(data, cv2.IMREAD_COLOR)
  height = round(width * image.shape[0] / image.shape[1])
  return np.asarray(cv2.resize(image[..., ::-1], (width, height), interpolation=cv2.INTER_NEAREST))


def _episodes(found: Sequence[Episode]) -> Section:
  rows = [
    (
      _title(episode),
      episode.index + 1,
      episode.group,
      episode.outcome,
      tables.NOTHING if episode.time is None else f"{episode.time:.1f} s",
      f"{episode.duration:.1f} s",
      tables.NOTHING
      if episode.localisation_error is None
      else f"{episode.localisation_error:.2f} m",
      episode.detail,
    )
    for episode in found
  ]
  header = (
    "setting",
    "trial",
    "group",
    "outcome",
    "time taken",
    "length",
    "localisation",
    "detail",
  )
  return Section("Episodes", "", [Details("all episodes", [Table(header, rows)])])
