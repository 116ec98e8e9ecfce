"""Charts of the report: lines over time, bins over a quantity, bars, intervals; as HTML fragments.

Shapes: N samples.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

Array = np.ndarray

BEFORE, AFTER, MEASURED = "#D55E00", "#0072B2", "#1d2330"
"""Colours of the declared model, the extended one and the machine (Okabe and Ito)."""

_POINTS = 1200  # a curve is thinned to this many points: a page of a few MB
_BINS = 24
_DIGITS = 6


def lines(
  title: str, x: str, y: str, curves: Sequence[tuple[str, str, Array, Array]], *, height: int = 280
) -> str:
  """Returns curves (name, colour, x [N], y [N]) in one chart."""
  figure = go.Figure()
  for name, color, along, values in curves:
    keep = slice(None, None, max(1, len(along) // _POINTS))
    figure.add_trace(
      go.Scatter(
        x=np.round(along[keep], _DIGITS),
        y=np.round(values[keep], _DIGITS),
        name=name,
        mode="lines",
        line={"color": color, "width": 1.4},
      )
    )
  return _html(figure, title, x, y, height)


def binned(
  title: str, x: str, y: str, curves: Sequence[tuple[str, str, Array, Array]], *, height: int = 280
) -> str:
  """Returns medians of curves (name, colour, x [N], y [N]) in bins of x, with quartiles."""
  figure = go.Figure()
  for name, color, along, values in curves:
    centre, low, middle, high = _bins(along, values)
    figure.add_trace(
      go.Scatter(
        x=centre,
        y=middle,
        name=name,
        mode="lines+markers",
        line={"color": color},
        marker={"size": 5},
        error_y={
          "type": "data",
          "array": high - middle,
          "arrayminus": middle - low,
          "thickness": 1,
          "width": 2,
        },
      )
    )
  return _html(figure, title, x, y, height)


def _bins(x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
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
  centre, low, middle, high = np.round(np.array(rows).T, _DIGITS)
  return centre, low, middle, high


def bars(title: str, x: str, rows: Sequence[tuple[str, str, Sequence[float]]], names) -> str:
  """Returns horizontal bars, series of (name, colour, values) over names from top to bottom."""
  figure = go.Figure()
  for name, color, values in rows:
    figure.add_trace(
      go.Bar(
        x=[float(v) for v in values][::-1],
        y=list(names)[::-1],
        name=name,
        orientation="h",
        marker_color=color,
      )
    )
  figure.update_layout(showlegend=len(rows) > 1, barmode="group")
  figure.update_yaxes(automargin=True)
  return _html(figure, title, x, "", 90 + (12 + 12 * len(rows)) * len(names))


def intervals(title: str, rows: Sequence[tuple[str, float, float, float]]) -> str:
  """Returns 95 % intervals (name, value, low, high) as percentages about their values."""
  shown = [r for r in rows if r[1]]
  if not shown:
    return ""
  names, value, low, high = zip(*shown[::-1], strict=True)
  size = np.abs(np.array(value))
  figure = go.Figure(
    go.Scatter(
      x=np.zeros(len(names)),
      y=names,
      mode="markers",
      marker={"color": AFTER, "size": 9},
      error_x={
        "type": "data",
        "array": 100 * (np.array(high) - value) / size,
        "arrayminus": 100 * (np.array(value) - low) / size,
        "color": AFTER,
        "thickness": 2,
      },
    )
  )
  figure.update_layout(showlegend=False)
  figure.update_yaxes(automargin=True)
  return _html(figure, title, "per cent of the value", "", 90 + 30 * len(names))


def _html(figure: go.Figure, title: str, x: str, y: str, height: int) -> str:
  layout: dict[str, Any] = {
    "title": {"text": title, "font": {"size": 14}, "x": 0.01, "y": 0.97, "yanchor": "top"},
    "template": "plotly_white",
    "height": height,
    "margin": {"l": 60, "r": 16, "t": 56, "b": 44},
    "xaxis_title": x,
    "yaxis_title": y,
    "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 1, "xanchor": "right"},
    "font": {"size": 12},
  }
  figure.update_layout(layout)
  return figure.to_html(
    full_html=False, include_plotlyjs=False, config={"responsive": True, "displayModeBar": False}
  )
