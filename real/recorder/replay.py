"""A recorded log as one page for the browser: plots over time, and what the camera saw.

Shapes: N messages of a topic, J joints.
"""

import base64
import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core import palette
from nerf2real.core.pages import page as pages
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs import streaming as recording

_MAX_POINTS = 4000  # of a plotted line: more than a screen has pixels
_TEMPERATURE = "temperature "  # before a joint, in names of series
_JOINT_TOPICS = {
  messages.COMMANDS: ("position", "command", "rad"),
  messages.STATES: ("position", "position", "rad"),
  messages.CURRENTS: ("effort", "current", "A"),
  messages.VOLTAGES: ("effort", "voltage", "V"),
  messages.PWM: ("effort", "duty", ""),
  messages.STAMPS: ("effort", "time of reading after the stamp", "s"),
}
_TOPICS = (
  *_JOINT_TOPICS,
  *(messages.IMU, messages.GRAVITY, messages.BATTERY, messages.IMAGE, messages.TEMPERATURE),
)


@dataclasses.dataclass
class Series:
  """Numbers over time."""

  unit: str
  names: tuple[str, ...]
  """Of the columns."""
  times: np.ndarray
  """[N] s from the log's start."""
  values: np.ndarray
  """[N, J]."""


@dataclasses.dataclass
class Replay:
  """What a log holds, ready to be shown."""

  name: str
  complete: bool
  """The recorder closed it properly."""
  start: float
  """s since 1970."""
  duration: float
  """s."""
  series: dict[str, Series]
  frames: list[tuple[float, bytes]]
  """Time [s from the start] and JPEG."""


def load(path: Path | str) -> Replay:
  """Reads a log, also one that was cut off.

  Raises:
    ValueError: No MCAP, or without a message that can be shown.
  """
  path = Path(path)
  collected: dict[str, tuple[str, tuple[str, ...], list[float], list[Any]]] = {}
  frames: list[tuple[float, bytes]] = []

  def add(name: str, unit: str, names: tuple[str, ...], time: float, values: Any) -> None:
    _, known, times, rows = collected.setdefault(name, (unit, names, [], []))
    if known == names:
      times.append(time)
      rows.append(values)

  for reading in recording.read_messages(path, topics=_TOPICS, recover=True):
    topic, time, message = reading.topic, reading.time, reading.message
    if topic in _JOINT_TOPICS:
      field, name, unit = _JOINT_TOPICS[topic]
      names = tuple(message.name)
      if len(getattr(message, field)) == len(names):
        add(name, unit, names, time, getattr(message, field))
      elif topic == messages.COMMANDS and len(message.effort) == len(names):
        add("commanded effort", "N m", names, time, message.effort)
      if topic == messages.STATES and len(message.velocity) == len(names):
        add("velocity", "rad/s", names, time, message.velocity)
    elif topic == messages.IMU:
      rate, force = message.angular_velocity, message.linear_acceleration
      add("turning rate", "rad/s", tuple("xyz"), time, (rate.x, rate.y, rate.z))
      add("specific force", "m/s^2", tuple("xyz"), time, (force.x, force.y, force.z))
    elif topic == messages.GRAVITY:
      down = message.vector
      add("direction of gravity", "", tuple("xyz"), time, (down.x, down.y, down.z))
    elif topic == messages.BATTERY:
      add("battery", "V", ("battery",), time, (message.voltage,))
    elif topic == messages.IMAGE and message.format == "jpeg":
      frames.append((time, bytes(message.data)))
    elif topic == messages.TEMPERATURE:
      joint = message.header.frame_id
      add(_TEMPERATURE + joint, "degrees C", (joint,), time, (message.temperature,))
  if not collected and not frames:
    raise ValueError(f"{path} holds no message that can be shown: record joints, IMU or pictures.")
  begins = [times[0] for _, _, times, _ in collected.values()] + [t for t, _ in frames[:1]]
  ends = [times[-1] for _, _, times, _ in collected.values()] + [t for t, _ in frames[-1:]]
  start = min(begins)
  return Replay(
    name=path.name,
    complete=recording.is_complete(path),
    start=start,
    duration=max(ends) - start,
    series={
      name: Series(unit, names, np.array(times) - start, np.array(rows, np.float64))
      for name, (unit, names, times, rows) in collected.items()
    },
    frames=[(time - start, data) for time, data in frames],
  )


def thin(series: Series) -> tuple[np.ndarray, np.ndarray]:
  """Returns times [M] and values [M, J] of at most `_MAX_POINTS` points, extremes kept.

  Of each stretch the smallest and the largest value of the first column that moves most are kept,
  so that a short peak does not vanish from the plot.
  """
  count = len(series.times)
  if count <= _MAX_POINTS:
    return series.times, series.values
  edges = np.linspace(0, count, _MAX_POINTS // 2 + 1).astype(int)
  column = int(np.argmax(np.ptp(series.values, axis=0)))
  kept = set()
  for first, last in itertools.pairwise(edges):
    stretch = series.values[first:last, column]
    kept |= {first + int(np.argmin(stretch)), first + int(np.argmax(stretch))}
  index = np.array(sorted(kept))
  return series.times[index], series.values[index]


@dataclasses.dataclass
class Plot:
  """Numbers over time, as the page's script takes them."""

  unit: str
  names: tuple[str, ...]
  """Of the lines."""
  t: list[float]
  """s."""
  y: list[list[float]]
  """Of each line."""


@dataclasses.dataclass
class Line:
  """A number over time."""

  t: list[float]
  """s."""
  y: list[float]


@dataclasses.dataclass
class PageData:
  """What the page's script shows."""

  joints: list[str]
  moving: str
  """The joint that is shown first."""
  duration: float
  """s."""
  series: dict[str, Plot]
  temperatures: dict[str, Line]
  """By joint [degrees C]."""
  frames: list[float]
  """Times of the pictures [s]."""
  pictures: list[str] | None
  """JPEG in base64; None where a server gives them."""


def _page_data(replay: Replay, *, embed: bool) -> PageData:
  moved = [replay.series[key] for key in ("position", "command") if key in replay.series]
  joints = list(dict.fromkeys(name for found in moved for name in found.names))
  series, temperatures = {}, {}
  for name, found in replay.series.items():
    if name.startswith(_TEMPERATURE):
      line = Line(np.round(found.times, 2).tolist(), found.values[:, 0].tolist())
      temperatures[name.removeprefix(_TEMPERATURE)] = line
      continue
    times, values = thin(found)
    t, y = np.round(times, 4).tolist(), np.round(values.T, 5).tolist()
    series[name] = Plot(found.unit, found.names, t, y)
  return PageData(
    joints=joints,
    moving=_most_moving(replay) or next(iter(joints), ""),
    duration=replay.duration,
    series=series,
    temperatures=temperatures,
    frames=[round(time, 4) for time, _ in replay.frames],
    pictures=[base64.b64encode(jpeg).decode() for _, jpeg in replay.frames] if embed else None,
  )


def _most_moving(replay: Replay) -> str:
  """Returns the joint that moves most, the one to look at first."""
  found = replay.series.get("position")
  return "" if found is None else found.names[int(np.argmax(np.ptp(found.values, axis=0)))]


def page(replay: Replay, *, embed: bool) -> str:
  """Returns the page.

  Args:
    replay: The log.
    embed: Puts the pictures into the page, so that it works without a server; otherwise they are
      asked for at `frame/<number>`.
  """
  data = _page_data(replay, embed=embed)
  lead = f"{replay.duration:.1f} s, {len(data.joints)} joints, {len(replay.frames)} pictures"
  if not replay.complete:
    lead += "; cut off: this is what was written until then"
  return pages.render(
    Path(__file__).with_name("replay.html"),
    plots=True,
    name=replay.name,
    lead=lead,
    data=data,
    colors=[palette.BLUE, palette.VERMILION, palette.GREEN, palette.PURPLE],
  )
