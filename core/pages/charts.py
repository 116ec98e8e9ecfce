"""Charts of reports: lines, medians in bins, bars, intervals, 3D figures; in plotly.

Shapes: N samples.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
import trimesh

from nerf2real.core import palette
from nerf2real.core.pages.blocks import Chart

Array = np.ndarray

_POINTS = 1200  # a curve is thinned to this many points: a page of a few MB
_BINS = 24
_WIDEST = 3.0


class Curve(NamedTuple):
  """Values along a quantity."""

  name: str
  color: str
  x: Array  # [N]
  y: Array  # [N]


class Bars(NamedTuple):
  """A series of bars."""

  name: str
  color: str
  values: Sequence[float]


class Interval(NamedTuple):
  """A value and the bounds that it lies within."""

  name: str
  value: float
  low: float
  high: float


def lines(title: str, x: str, y: str, curves: Sequence[Curve]) -> Chart:
  """Returns curves in one chart; x and y name the axes with their units."""
  figure = go.Figure()
  for curve in curves:
    keep = slice(None, None, max(1, len(curve.x) // _POINTS))
    figure.add_scatter(
      x=_short(curve.x[keep]),
      y=_short(curve.y[keep]),
      name=curve.name,
      mode="lines",
      line={"color": curve.color, "width": 1.4},
    )
  return _laid_out(figure, title, x, y)


def binned(title: str, x: str, y: str, curves: Sequence[Curve]) -> Chart:
  """Returns medians of curves in bins of x, with quartiles; x and y name the axes."""
  figure = go.Figure()
  for curve in curves:
    center, low, middle, high = _quartiles(curve.x, curve.y)
    figure.add_scatter(
      x=_short(center),
      y=_short(middle),
      name=curve.name,
      mode="lines+markers",
      line={"color": curve.color},
      marker={"size": 5},
      error_y={
        "type": "data",
        "array": _short(high - middle),
        "arrayminus": _short(middle - low),
        "thickness": 1,
        "width": 2,
      },
    )
  return _laid_out(figure, title, x, y)


def _quartiles(x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
  """Returns mean x and quartiles of y in bins that hold equally many samples."""
  edges = np.unique(np.quantile(x, np.linspace(0, 1, _BINS + 1)))
  if len(edges) < 3:
    edges = np.array([x.min(), x.max() + 1e-9])
  which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
  rows = [
    (x[which == k].mean(), *np.quantile(y[which == k], (0.25, 0.5, 0.75)))
    for k in range(len(edges) - 1)
    if np.any(which == k)
  ]
  center, low, middle, high = np.array(rows).T
  return center, low, middle, high


def bars(
  title: str, x: str, series: Sequence[Bars], names: Sequence[str], *, stacked: bool = False
) -> Chart:
  """Returns horizontal bars of series over names from top to bottom, side by side or stacked."""
  figure = go.Figure()
  for name, color, values in series:
    figure.add_bar(
      x=[float(v) for v in values][::-1],
      y=list(names)[::-1],
      name=name,
      orientation="h",
      marker_color=color,
    )
  figure.update_layout(showlegend=len(series) > 1, barmode="stack" if stacked else "group")
  rows = 1 if stacked else len(series)
  return _laid_out(figure, title, x, "", 90 + (12 + 12 * rows) * len(names))


def intervals(title: str, rows: Sequence[Interval]) -> Chart | None:
  """Returns intervals as percentages about their values; None where none is shown.

  One that reaches farther than `_WIDEST` times its value would squeeze the others to points.
  """
  reach = [max(row.high - row.value, row.value - row.low) for row in rows]
  shown = [
    r for r, far in zip(rows, reach, strict=True) if r.value and far <= _WIDEST * abs(r.value)
  ]
  if not shown:
    return None
  names, value, low, high = zip(*shown[::-1], strict=True)
  size = np.abs(np.array(value))
  figure = go.Figure()
  figure.add_scatter(
    x=np.zeros(len(names)),
    y=names,
    mode="markers",
    marker={"color": palette.BLUE, "size": 9},
    error_x={
      "type": "data",
      "array": 100 * (np.array(high) - value) / size,
      "arrayminus": 100 * (np.array(value) - low) / size,
      "color": palette.BLUE,
      "thickness": 2,
    },
  )
  figure.update_layout(showlegend=False)
  return _laid_out(figure, title, "per cent of the value", "", 100 + 30 * len(names))


def _laid_out(figure: go.Figure, title: str, x: str, y: str, height: int = 280) -> Chart:
  legend = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 1, "xanchor": "right"}
  figure.update_layout(
    title={"text": title, "font": {"size": 14}, "x": 0.01, "y": 0.97, "yanchor": "top"},
    height=height,
    margin={"l": 60, "r": 16, "t": 56, "b": 44},
    xaxis_title=x,
    yaxis_title=y,
    legend=legend,
  )
  return Chart(figure)


def mesh_trace(mesh: trimesh.Trimesh, *, color: str | None = None, name: str) -> go.Mesh3d:
  """Returns a mesh for a 3D figure, in its vertex colours unless `color` is given."""
  vertices, faces = _short(mesh.vertices), np.asarray(mesh.faces)
  if len(vertices) < 1 << 16:
    faces = faces.astype(np.uint16)
  colors = None
  if color is None:
    rgb = np.asarray(mesh.visual.vertex_colors)[:, :3]  # type: ignore[union-attr]
    colors = [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in rgb]
  return go.Mesh3d(
    **dict(zip("xyz", vertices.T, strict=True)),
    **dict(zip("ijk", faces.T, strict=True)),
    color=color,
    vertexcolor=colors,
    name=name,
    hoverinfo="name",
    flatshading=color is not None,
  )


def path_trace(points: Array, *, joined: bool = True) -> go.Scatter3d:
  """Returns a camera's path through points [N, 3], or the points alone, for a 3D figure."""
  return go.Scatter3d(
    **dict(zip("xyz", _short(points).T, strict=True)),
    mode="lines+markers" if joined else "markers",
    name="cameras",
    marker={"size": 2.5, "color": palette.VERMILION},
    line={"width": 3, "color": palette.VERMILION},
  )


def figure_3d(traces: Sequence[Any]) -> Chart:
  """Returns an interactive 3D figure in metres, z up; drag turns it."""
  axis = {"showbackground": False, "gridcolor": "#dfe3ea", "zerolinecolor": "#dfe3ea"}
  figure = go.Figure(list(traces))
  figure.update_layout(
    height=560,
    margin={"l": 0, "r": 0, "t": 0, "b": 0},
    showlegend=False,
    scene={
      "aspectmode": "data",
      "dragmode": "turntable",
      **{f"{name}axis": {**axis, "title": {"text": f"{name} [m]"}} for name in "xyz"},
      "camera": {"eye": {"x": -1.1, "y": -1.35, "z": 1.5}, "center": {"x": 0, "y": 0, "z": -0.25}},
    },
  )
  return Chart(figure, tools=True)


def _short(values: Any) -> Array:
  """Returns values in single precision: half of a page's size, exact to 7 digits."""
  return np.asarray(values, np.float32)
