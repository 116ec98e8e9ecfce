"""The paper's tables I, II and V from episodes, with its own figures beside them.

Byravan et al. 2022, NeRF2Real: table I (navigation), II (ball pushing) and V (camera gain, in the
appendix). Success has the standard error of a share from the sample's deviation,
sqrt(p (1 - p) / (n - 1)): with it the paper's own errors follow from its counts (6 of 14: 43±14 %).
Medians have one from a bootstrap over the episodes.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.core import markdown
from nerf2real.core.intervals import clopper_pearson
from nerf2real.evaluation import episodes as kept
from nerf2real.evaluation.episodes import Episode, select
from nerf2real.suite import protocols

_BOOTSTRAP = 2000  # resamples
NOTHING = "-"

# Paper, table I: resolution -> success, time, localisation error in simulation, then transferred.
PAPER_NAVIGATION = {
  "30 x 40": ("73±3%", "10.3±0.3 sec", "0.17±0.01 m", "69±6%", "10.3±0.4 sec", "0.24±0.01 m"),
  "60 x 80": ("86±2%", "10.8±0.1 sec", "0.19±0.004 m", "87±5%", "11.2±0.4 sec", "0.27±0.04 m"),
}
# Paper, table II: success in simulation (Center, Wall), then real.
PAPER_BALL = {"30 x 40": ("99%", "100%", "78±7%", "43±14%")}
# Paper, table V: gain -> success.
PAPER_GAIN = {128: "0/5", 90: "0/5", 50: "4/5", 10: "1/5", 1: "2/5"}
PLANTS = {"sim": "Simulation", "virtual": "Virtual robot", "robot": "Robot"}


class Estimate(NamedTuple):
  """A figure with its standard error, from n episodes."""

  value: float
  error: float
  episodes: int


class Row(NamedTuple):
  """A row of a table: what it is of, and its cells."""

  name: str
  cells: tuple[str, ...]


class Table(NamedTuple):
  """A table as the paper has it."""

  title: str
  header: tuple[str, ...]  # with the name's column first
  rows: tuple[Row, ...]


def success_rate(found: Sequence[Episode]) -> Estimate | None:
  """Returns the share of successes; None without episodes."""
  if not found:
    return None
  count = len(found)
  share = sum(episode.success for episode in found) / count
  error = math.sqrt(share * (1 - share) / (count - 1)) if count > 1 else math.nan
  return Estimate(share, error, count)


def median(values: Sequence[float]) -> Estimate | None:
  """Returns the median and its bootstrapped standard error; None without values."""
  if not len(values):
    return None
  array = np.asarray(values, np.float64)
  draws = np.random.default_rng(0).choice(array, (_BOOTSTRAP, len(array)))
  error = float(np.median(draws, axis=1).std()) if len(array) > 1 else math.nan
  return Estimate(float(np.median(array)), error, len(array))


def time_taken(found: Sequence[Episode]) -> Estimate | None:
  """Returns the median time to the goal over the successful episodes [s]."""
  return median([episode.time for episode in found if episode.time is not None])


def localisation_error(found: Sequence[Episode]) -> Estimate | None:
  """Returns the median over episodes of the mean localisation error [m]."""
  return median([e.localisation_error for e in found if e.localisation_error is not None])


def _percent(estimate: Estimate | None) -> str:
  if estimate is None:
    return NOTHING
  error = "" if math.isnan(estimate.error) else f"±{100 * estimate.error:.0f}"
  return f"{100 * estimate.value:.0f}{error}% (n={estimate.episodes})"


def _number(estimate: Estimate | None, digits: int, unit: str) -> str:
  if estimate is None:
    return NOTHING
  error = "" if math.isnan(estimate.error) else f"±{estimate.error:.{digits}f}"
  return f"{estimate.value:.{digits}f}{error} {unit}"


def policies(found: Sequence[Episode]) -> list[tuple[str, str, str]]:
  """Returns (name, digest, resolution) of every policy, in the order of the episodes."""
  return list(
    dict.fromkeys((e.setting.policy, e.setting.policy_id, e.setting.resolution) for e in found)
  )


def _label(policy: tuple[str, str, str], found: Sequence[Episode]) -> str:
  name, digest, size = policy
  twins = {p for p in policies(found) if (p[0], p[2]) == (name, size)}
  return f"{size} ({name})" if len(twins) == 1 else f"{size} ({name}, {digest})"


def navigation_table(found: Sequence[Episode]) -> Table:
  """Returns table I: success, time taken and localisation error, side by side."""
  header = ["Policy resolution"]
  for plant in PLANTS:
    header += [f"{PLANTS[plant]}: {c}" for c in ("Success", "Time taken", "Localization error")]
  rows = []
  for policy in policies(found):
    own = select(found, policy_id=policy[1], resolution=policy[2])
    cells: list[str] = []
    for plant in PLANTS:
      chosen = select(own, plant=plant)
      cells += [
        _percent(success_rate(chosen)),
        _number(time_taken(chosen), 1, "sec"),
        _number(localisation_error(chosen), 2, "m"),
      ]
    rows.append(Row(_label(policy, found), tuple(cells)))
  for size, figures in PAPER_NAVIGATION.items():
    rows.append(Row(f"{size} (paper)", (*figures[:3], *[NOTHING] * 3, *figures[3:])))
  return Table("Table I: navigation and obstacle avoidance", tuple(header), tuple(rows))


def ball_table(found: Sequence[Episode]) -> Table:
  """Returns table II: success of ball pushing by where the ball starts."""
  header = ["Policy resolution"]
  for plant in PLANTS:
    header += [f"{PLANTS[plant]}: {setting}" for setting in ("Center", "Wall")]
  rows = []
  for policy in policies(found):
    own = select(found, policy_id=policy[1], resolution=policy[2])
    cells = [
      _percent(success_rate(select(own, plant=plant, group=group)))
      for plant in PLANTS
      for group in ("center", "wall")
    ]
    rows.append(Row(_label(policy, found), tuple(cells)))
  for size, figures in PAPER_BALL.items():
    rows.append(Row(f"{size} (paper)", (*figures[:2], *[NOTHING] * 2, *figures[2:])))
  return Table("Table II: ball pushing", tuple(header), tuple(rows))


def behaviour(found: Sequence[Episode]) -> str:
  """Says in words what happened in some episodes."""
  counts = Counter(episode.outcome for episode in found)
  said = {
    kept.SUCCESS: "reached the goal",
    kept.COLLISION: "hit an obstacle",
    kept.FALL: "fell",
    kept.LOST: "got lost",
    kept.STOPPED: "was stopped",
  }
  parts = [f"{said[name]} {counts[name]}/{len(found)}" for name in kept.OUTCOMES if counts[name]]
  return ", ".join(parts) if parts else NOTHING


def gain_table(found: Sequence[Episode]) -> Table:
  """Returns table V: success and behaviour by the camera's gain."""
  plants = [plant for plant in PLANTS if select(found, plant=plant)]
  header = ["Gain"]
  for plant in plants:
    header += [f"{PLANTS[plant]}: Success rate", f"{PLANTS[plant]}: Behavior"]
  rows = []
  for policy in policies(found):
    for gain in protocols.GAINS:
      cells: list[str] = []
      for plant in plants:
        chosen = select(
          found, policy_id=policy[1], resolution=policy[2], plant=plant, group=f"gain {gain}"
        )
        count = sum(episode.success for episode in chosen)
        cells += [f"{count}/{len(chosen)}" if chosen else NOTHING, behaviour(chosen)]
      name = f"{gain}, {_label(policy, found)} (paper: {PAPER_GAIN[gain]})"
      rows.append(Row(name, tuple(cells)))
  return Table("Table V: camera gain", tuple(header), tuple(rows))


def changes(setting: kept.Setting) -> str:
  """Says what was disturbed, falsified or changed, after a comma; empty if nothing was."""
  control = "" if setting.control == "none" else f"control {setting.control}"
  disturbed = "" if setting.perturbation == "none" else setting.perturbation
  return "".join(f", {change}" for change in (disturbed, control, setting.conditions) if change)


def exact_rate(successes: int, count: int) -> str:
  """Says a rate with its exact 95 % interval (Clopper and Pearson 1934), such as
  "7/9, 40 to 97 %"."""
  low, high = clopper_pearson(successes, count)
  return f"{successes}/{count}, {100 * low:.0f} to {100 * high:.0f} %"


def outcome_table(found: Sequence[Episode]) -> Table:
  """Returns how the episodes of each setting ended."""
  header = (
    "Policy, plant, protocol, perturbation, control",
    "episodes",
    *kept.OUTCOMES,
    "success, exact 95 % interval",
    "localisation error when successful",
    "and when failed",
  )
  rows = []
  for setting in dict.fromkeys(episode.setting for episode in found):
    chosen = [episode for episode in found if episode.setting == setting]
    counts = Counter(episode.outcome for episode in chosen)
    cells = (
      str(len(chosen)),
      *(str(counts[name]) for name in kept.OUTCOMES),
      exact_rate(counts[kept.SUCCESS], len(chosen)),
      _number(localisation_error([e for e in chosen if e.success]), 2, "m"),
      _number(localisation_error([e for e in chosen if not e.success]), 2, "m"),
    )
    policy = (setting.policy, setting.policy_id, setting.resolution)
    name = (
      f"{_label(policy, found)}, {PLANTS[setting.plant]} ({setting.plant_id}), {setting.protocol}"
    )
    rows.append(Row(name + changes(setting), cells))
  return Table("How the episodes ended", header, tuple(rows))


_MAKERS = {"navigation": navigation_table, "ball": ball_table, "gain": gain_table}


def paper_tables(found: Sequence[Episode]) -> list[Table]:
  """Returns the paper's tables for which there are undisturbed episodes, apart by conditions."""
  plain = select(found, perturbation="none", control="none")
  made = []
  for conditions in dict.fromkeys(episode.setting.conditions for episode in plain):
    for protocol, make in _MAKERS.items():
      chosen = select(plain, protocol=protocol, conditions=conditions)
      if chosen:
        table = make(chosen)
        title = f"{table.title}; {conditions}" if conditions else table.title
        made.append(table._replace(title=title))
  return made


def as_text(table: Table) -> str:
  """Returns a table in Markdown."""
  rows = markdown.table(table.header, [(row.name, *row.cells) for row in table.rows])
  return f"{table.title}\n\n{rows}\n"
