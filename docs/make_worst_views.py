"""Draws a picture of docs/pictures: held-out views as the reports of bundles show them.

python docs/make_worst_views.py worst_views "five minutes=out/fast" "an hour=out/quality:000644"
"""

import base64
import re
import sys
from pathlib import Path

import cv2
import numpy as np

_WIDTH, _GAP, _LINE = 340, 8, 20  # of a picture, between two, of a line of text [px]
_FIGURE = re.compile(r'src="data:image/jpeg;base64,([^"]+)">\s*<figcaption>([^<]*)')
_KINDS = 3  # picture, field, error


def _held_out(report: Path, frame: str) -> list[tuple[np.ndarray, str]]:
  """Returns pictures with captions of a frame, of the first (the worst) for ""."""
  page = report.read_text()
  section = page[page.index("<h2>Held-out views") :].split("<h2>")[1]
  figures = _FIGURE.findall(section)
  starts = [k for k, (_, caption) in enumerate(figures) if frame in caption.partition(":")[0]]
  if not starts:
    raise SystemExit(f"{report} shows no frame {frame}: take one of its held-out views.")
  return [(_decoded(data), caption) for data, caption in figures[starts[0] : starts[0] + _KINDS]]


def _decoded(data: str) -> np.ndarray:
  raw = np.frombuffer(base64.b64decode(data), np.uint8)
  return np.asarray(cv2.imdecode(raw, cv2.IMREAD_COLOR))


def _row(title: str, shown: list[tuple[np.ndarray, str]]) -> np.ndarray:
  captions = (title, shown[1][1], "error, white is a quarter of full scale")
  columns = []
  for (picture, _), caption in zip(shown, captions, strict=True):
    height = round(picture.shape[0] * _WIDTH / picture.shape[1])
    small = cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    line = np.full((_LINE, _WIDTH, 3), 255, np.uint8)
    cv2.putText(line, caption, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30,) * 3, 1, cv2.LINE_AA)
    columns += [np.vstack([line, small]), np.full((_LINE + height, _GAP, 3), 255, np.uint8)]
  return np.hstack(columns[:-1])


def main() -> None:
  """Writes the picture beside this script."""
  rows = []
  name, *wanted = sys.argv[1:]
  for argument in wanted:
    title, _, place = argument.partition("=")
    folder, _, frame = place.partition(":")
    rows.append(_row(title, _held_out(Path(folder) / "report.html", frame)))
  path = Path(__file__).parent / "pictures" / f"{name}.jpg"
  cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 78])


if __name__ == "__main__":
  main()
