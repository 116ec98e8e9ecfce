"""Building blocks of report pages: pictures, maps, tables and 3D figures as HTML fragments.

Everything is embedded, so that a page opens offline. Shapes: H height, W width.
"""

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import plotly.graph_objects as go
import plotly.offline
import trimesh

_JPEG_QUALITY = 88
# Okabe and Ito's palette for the colour blind, then lighter variants.
_PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#999999")

STYLE = """
:root { --ink: #1d2330; --soft: #5c6675; --line: #dfe3ea; --paper: #ffffff; --wash: #f5f7fa;
        --accent: #0b63b0; --warn: #a85800; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--wash); color: var(--ink);
       font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 28px 20px 60px; }
header { border-bottom: 1px solid var(--line); padding-bottom: 14px; margin-bottom: 20px; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 19px; margin: 0 0 10px; }
p.lead { color: var(--soft); margin: 4px 0 0; max-width: 75ch; }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 8px;
          padding: 18px 20px; margin: 0 0 18px; overflow-x: auto; }
section > p { color: var(--soft); margin: 0 0 12px; max-width: 80ch; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: 5px 10px; border-bottom: 1px solid var(--line);
         vertical-align: top; }
th { color: var(--soft); font-weight: 600; } td.number { font-variant-numeric: tabular-nums;
     white-space: nowrap; }
.grid { display: grid; gap: 10px; }
figure { margin: 0; } figure img { width: 100%; display: block; border-radius: 4px; }
img.pixelated { image-rendering: pixelated; }
figcaption { color: var(--soft); font-size: 13px; margin-top: 3px; }
.warning { border-left: 4px solid var(--warn); background: #fff6e9; padding: 8px 12px;
           margin: 0 0 8px; border-radius: 0 6px 6px 0; }
.bar { background: var(--accent); height: 12px; border-radius: 3px; min-width: 2px; }
details pre { overflow-x: auto; font-size: 12px; }
"""


def page(title: str, lead: str, sections: Sequence[str], *, with_plots: bool) -> str:
  """Returns a whole HTML page."""
  script = f"<script>{plotly.offline.get_plotlyjs()}</script>" if with_plots else ""
  return (
    "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
    "<meta name='viewport' content='width=device-width, initial-scale=1'>"
    f"<title>{html.escape(title)}</title><style>{STYLE}</style>{script}</head><body><main>"
    f"<header><h1>{html.escape(title)}</h1><p class='lead'>{html.escape(lead)}</p></header>"
    + "\n".join(sections)
    + "</main></body></html>"
  )


def section(title: str, text: str, *content: str) -> str:
  """Returns a titled block with a sentence and its content."""
  lead = f"<p>{html.escape(text)}</p>" if text else ""
  return f"<section><h2>{html.escape(title)}</h2>{lead}{''.join(content)}</section>"


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
  """Returns a table; numbers are set in tabular figures."""
  head = "".join(f"<th>{html.escape(str(cell))}</th>" for cell in header)
  body = []
  for row in rows:
    cells = []
    for cell in row:
      text = f"{cell:.4g}" if isinstance(cell, float) else str(cell)
      kind = " class='number'" if isinstance(cell, (int, float)) else ""
      cells.append(f"<td{kind}>{html.escape(text)}</td>")
    body.append(f"<tr>{''.join(cells)}</tr>")
  return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"


def picture(image: np.ndarray, caption: str = "", *, pixelated: bool = False) -> str:
  """Returns a picture [H, W, 3] or [H, W] (uint8) embedded as JPEG, or PNG where pixels matter."""
  channels = image[..., ::-1] if image.ndim == 3 else image
  if pixelated:
    _, data = cv2.imencode(".png", channels)
    kind, style = "png", " class='pixelated'"
  else:
    _, data = cv2.imencode(".jpg", channels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    kind, style = "jpeg", ""
  encoded = base64.b64encode(data.tobytes()).decode()
  text = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
  alt = html.escape(caption or "picture", quote=True)
  return f"<figure><img{style} alt='{alt}' src='data:image/{kind};base64,{encoded}'>{text}</figure>"


def grid(fragments: Sequence[str], columns: int) -> str:
  """Lays fragments out in columns."""
  style = f"grid-template-columns: repeat({columns}, minmax(0, 1fr))"
  return f"<div class='grid' style='{style}'>{''.join(fragments)}</div>"


def warnings(messages: Sequence[str]) -> str:
  """Returns warnings as highlighted lines."""
  return "".join(f"<div class='warning'>{html.escape(message)}</div>" for message in messages)


def times(seconds: Mapping[str, float]) -> str:
  """Returns stage times as bars."""
  longest = max(seconds.values(), default=1.0) or 1.0
  rows = "".join(
    f"<tr><td>{html.escape(name)}</td><td class='number'>{value:.1f} s</td>"
    f"<td style='width:60%'><div class='bar' style='width:{100 * value / longest:.1f}%'></div></td>"
    "</tr>"
    for name, value in seconds.items()
  )
  total = f"<tr><th>total</th><th>{sum(seconds.values()):.1f} s</th><th></th></tr>"
  return f"<table><tbody>{rows}{total}</tbody></table>"


def details(title: str, text: str) -> str:
  """Returns folded text."""
  return f"<details><summary>{html.escape(title)}</summary><pre>{html.escape(text)}</pre></details>"


def error_map(truth: np.ndarray, image: np.ndarray, *, full_scale: int = 64) -> np.ndarray:
  """Colours the absolute difference of two pictures [H, W, 3]; `full_scale` of 255 is brightest."""
  difference = np.abs(truth.astype(np.int16) - image).mean(-1) * (255.0 / full_scale)
  levels = np.clip(difference, 0, 255).astype(np.uint8)
  return cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1]


def depth_map(depth: np.ndarray, *, percentile: float = 98.0) -> np.ndarray:
  """Colours a depth picture [H, W], near is bright; black where nothing was hit."""
  hit = np.isfinite(depth)
  if not hit.any():
    return np.zeros((*depth.shape, 3), np.uint8)
  far = np.percentile(depth[hit], percentile)
  levels = np.where(hit, 255 * (1 - np.clip(depth / max(far, 1e-9), 0, 1)), 0).astype(np.uint8)
  colored = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1].copy()
  colored[~hit] = 0
  return colored


def mesh_trace(
  mesh: trimesh.Trimesh, *, color: str | None = None, name: str = "", opacity: float = 1.0
) -> go.Mesh3d:
  """Returns a mesh for a 3D figure, in its vertex colours unless `color` is given."""
  vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
  colors = None
  if color is None:
    rgb = np.asarray(mesh.visual.vertex_colors)[:, :3]  # type: ignore[union-attr]
    colors = [f"rgb({r},{g},{b})" for r, g, b in rgb]
  return go.Mesh3d(
    x=np.round(vertices[:, 0], 3),
    y=np.round(vertices[:, 1], 3),
    z=np.round(vertices[:, 2], 3),
    i=faces[:, 0],
    j=faces[:, 1],
    k=faces[:, 2],
    color=color,
    vertexcolor=colors,
    name=name,
    opacity=opacity,
    hoverinfo="name",
    flatshading=color is not None,
  )


def part_color(index: int) -> str:
  """Returns a colour for the index-th convex part."""
  return _PALETTE[index % len(_PALETTE)]


def path_trace(points: np.ndarray, *, name: str = "camera path") -> go.Scatter3d:
  """Returns a line through points [N, 3]."""
  return go.Scatter3d(
    x=points[:, 0],
    y=points[:, 1],
    z=points[:, 2],
    mode="lines+markers",
    name=name,
    marker={"size": 2.5, "color": "#D55E00"},
    line={"width": 3, "color": "#D55E00"},
  )


def figure_3d(traces: Sequence[Any], *, height: int = 560) -> str:
  """Returns an interactive 3D figure in metres; drag turns it."""
  axis = {"showbackground": False, "gridcolor": "#dfe3ea", "zerolinecolor": "#dfe3ea"}
  figure = go.Figure(list(traces))
  figure.update_layout(
    height=height,
    margin={"l": 0, "r": 0, "t": 0, "b": 0},
    showlegend=False,
    scene={
      "aspectmode": "data",
      "xaxis": {**axis, "title": {"text": "x [m]"}},
      "yaxis": {**axis, "title": {"text": "y [m]"}},
      "zaxis": {**axis, "title": {"text": "z [m]"}},
      "camera": {"eye": {"x": -0.9, "y": -1.1, "z": 1.3}},
    },
  )
  return figure.to_html(full_html=False, include_plotlyjs=False)
