"""Learning curves of runs, as a picture and a table.

  python benchmarks/learning/curves.py --name cartpole_swingup runs/x runs/y

Reads the folders that `launch/local_distributed.py` writes, one a seed, and writes
benchmarks/results/curves/<name>.jsonl and .png. The rows: one "run" row a run (command, seed,
settings, time, hardware), its evaluations (means over some episodes with the policy's mean action),
its acting returns and localisation errors as means over blocks of episodes. --target draws a line.
"""

import dataclasses
import json
import os
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import tyro

from benchmarks import harness
from nerf2real.agents.processes.checkpoints import read_info

WIDTH, HEIGHT = 960, 540  # pixels
LEFT, RIGHT, TOP, BOTTOM = 80, 20, 60, 60  # margins [pixels]
BLOCKS = 60  # means of the acting returns in a run
COLOURS = [(31, 119, 180), (214, 39, 40), (44, 160, 44), (148, 103, 189), (255, 127, 14)]
GREY = (110, 110, 110)
Point = tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
  """What to draw."""

  runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
  """Folders of runs, one a seed."""
  name: str
  """Name of the files."""
  target: float | None = None
  """Draws a dashed line at this return."""
  note: str = ""
  """A remark kept with the rows, such as the load."""
  out: Path = Path("benchmarks/results/curves")
  """Folder of the curves."""
  write: bool = False
  """Keep the best returns as records in benchmarks/results/records/."""


def read_run(folder: Path) -> dict[str, Any]:
  """Reads a run's rows: {"about", "evaluations", "acting", "localisation"}."""
  rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
  launches = [json.loads(line) for line in (folder / "launches.jsonl").read_text().splitlines()]
  info = read_info(folder) or {}
  evaluations = [
    r
    for r in rows
    if r["source"].startswith("evaluator") and "return" in r and not r.get("confirmation")
  ]
  episodes = [r for r in rows if r["source"].startswith("actor") and "return" in r]
  seconds = sum(_span([r["time"] for r in rows], launches, i) for i in range(len(launches)))
  last = rows[-1]
  return {
    "about": {
      "row": "run",
      "command": launches[0]["command"],
      "launches": len(launches),
      "environment": info.get("environment"),
      "seed": info.get("seed"),
      "processor": launches[0]["processor"],
      "cores": launches[0]["cores"],
      "seconds": round(seconds),
      "steps": last["steps"],
      "updates": last["updates"],
      "steps_per_second": round(last["steps"] / max(seconds, 1e-9), 1),
      "updates_per_second": round(last["updates"] / max(seconds, 1e-9), 2),
      "settings": info.get("config"),
    },
    "evaluations": [
      {
        "row": "evaluation",
        "steps": r["steps"],
        "seconds": round(r["time"] - launches[0]["time"]),
        "return": round(r["return"], 2),
        "episodes": r["episodes"],
      }
      | {k: round(r[k], 3) for k in ("success", "localisation_error") if r.get(k) is not None}
      for r in evaluations
    ],
    "acting": _blocks(episodes, "return"),
    "localisation": _blocks(episodes, "localisation_error"),
  }


def _span(times: list[float], launches: list[dict[str, Any]], index: int) -> float:
  """Seconds from a launch to its last row."""
  begin = launches[index]["time"]
  end = launches[index + 1]["time"] if index + 1 < len(launches) else np.inf
  return max([t for t in times if begin <= t < end], default=begin) - begin


def _blocks(episodes: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
  found = [(r["steps"], r[name]) for r in episodes if r.get(name) is not None]
  if not found:
    return []
  groups = np.array_split(np.array(found), min(BLOCKS, len(found)))
  return [
    {
      "row": f"acting {name}",
      "steps": int(g[-1, 0]),
      "mean": round(float(g[:, 1].mean()), 3),
      "episodes": len(g),
    }
    for g in groups
  ]


def draw(
  runs: list[dict[str, Any]], *, title: str, kind: str = "return", target: float | None = None
) -> np.ndarray:
  """Draws evaluations as lines with points and acting means as thin lines; uint8 [H, W, 3] RGB.

  Args:
    runs: from `read_run`.
    title: what stands above.
    kind: "return", or "localisation_error" for the belief's error while acting [m].
    target: value of a dashed line.
  """
  curves: list[tuple[list[Point], list[Point]]] = []
  for run in runs:
    acting = run["acting"] if kind == "return" else run["localisation"]
    curves.append(
      (
        [(r["steps"], r[kind]) for r in run["evaluations"] if kind in r],
        [(r["steps"], r["mean"]) for r in acting],
      )
    )
  points = [p for pair in curves for curve in pair for p in curve]
  if not points:
    raise ValueError(f"The runs hold no {kind}.")
  right = max(p[0] for p in points) or 1.0
  values = [p[1] for p in points] + ([target] if target is not None else [])
  low, high = min(0.0, *values), max(values)
  high = high + 0.05 * (high - low or 1.0)
  picture = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)

  def place(point: Point) -> tuple[int, int]:
    x = LEFT + (WIDTH - LEFT - RIGHT) * point[0] / right
    y = HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (point[1] - low) / (high - low)
    return round(x), round(y)

  def write(text: str, at: tuple[int, int], colour: tuple[int, int, int], size: float) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)

  for value in _ticks(low, high):
    cv2.line(picture, place((0, value)), place((right, value)), (225, 225, 225), 1)
    write(f"{value + 0.0:g}", (8, place((0, value))[1] + 5), GREY, 0.45)
  for value in _ticks(0, right):
    column = place((value, low))[0]
    cv2.line(picture, (column, TOP), (column, HEIGHT - BOTTOM), (235, 235, 235), 1)
    write(f"{value:,.0f}", (column - 20, HEIGHT - BOTTOM + 20), GREY, 0.45)
  if target is not None:
    (x, y), (end, _) = place((0, target)), place((right, target))
    for column in range(x, end, 12):
      cv2.line(picture, (column, y), (column + 6, y), (0, 0, 0), 1)
  write(title, (LEFT, 30), (0, 0, 0), 0.6)
  write("environment steps; points: evaluated, thin: while acting", (LEFT, HEIGHT - 15), GREY, 0.45)
  for index, (evaluated, acting) in enumerate(curves):
    colour = COLOURS[index % len(COLOURS)]
    pale = tuple(round(255 - 0.45 * (255 - c)) for c in colour)
    for curve, tone, thickness in ((acting, pale, 1), (evaluated, colour, 2)):
      corners = np.array([place(p) for p in curve], np.int32)
      if len(corners):
        cv2.polylines(picture, [corners], False, tone, thickness, cv2.LINE_AA)
    for point in evaluated:
      cv2.circle(picture, place(point), 4, colour, -1, cv2.LINE_AA)
    label = f"seed {runs[index]['about']['seed']}"
    write(label, (WIDTH - RIGHT - 90 * (len(curves) - index), 30), colour, 0.5)
  return picture


def _ticks(low: float, high: float) -> np.ndarray:
  """About six round numbers from low to high."""
  step = 10.0 ** np.floor(np.log10((high - low) / 6))
  step = next(step * m for m in (1, 2, 5, 10) if (high - low) / (step * m) <= 7)
  return np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step


def main(settings: Settings) -> None:
  """Writes the rows and the picture, prints the best returns."""
  runs = [read_run(folder) for folder in settings.runs]
  settings.out.mkdir(parents=True, exist_ok=True)
  path = settings.out / f"{settings.name}.jsonl"
  with path.open("w") as stream:
    for run in runs:
      about = run["about"] | ({"note": settings.note} if settings.note else {})
      for row in (about, *run["evaluations"], *run["acting"], *run["localisation"]):
        stream.write(json.dumps(row) + "\n")
  title = f"{runs[0]['about']['environment']}, return"
  pictures = [draw(runs, title=title, target=settings.target)]
  if any(run["localisation"] for run in runs):
    title = f"{runs[0]['about']['environment']}, error of the believed position [m]"
    pictures.append(draw(runs, title=title, kind="localisation_error"))
  picture = np.concatenate(pictures)
  cv2.imwrite(os.fspath(path.with_suffix(".png")), picture[..., ::-1])
  figures: dict[str, dict[str, harness.Value]] = {}
  for run in runs:
    best = max((r["return"] for r in run["evaluations"]), default=float("nan"))
    about = run["about"]
    names = ("steps", "seconds", "steps_per_second", "updates_per_second")
    figures[f"{settings.name} seed {about['seed']}"] = {
      "best_return": float(best),
      **{name: about[name] for name in names},
    }
  harness.finish("curves", figures, harness.Options(write=settings.write), words=settings.note)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
