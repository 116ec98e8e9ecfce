"""Keyframes on disk: what the first stage leaves for the others."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core.cameras import Camera
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.capture.sources import KnownPoses

_RECORD = "capture.json"


def save(taken: Capture, folder: Path) -> None:
  """Writes what is known of the keyframes beside them, into capture.json."""
  values: dict[str, Any] = {
    "kind": taken.kind,
    "images": [path.name for path in taken.images],
    "width": taken.width,
    "height": taken.height,
    "sharpness": taken.sharpness.tolist(),
    "brightness": taken.brightness.tolist(),
    "times": None if taken.times is None else taken.times.tolist(),
    "warnings": list(taken.warnings),
    "known": None,
  }
  if taken.known is not None:
    known = dataclasses.asdict(taken.known)
    known["files"] = [str(path) for path in taken.known.files]
    for name in ("world_from_camera", "points", "point_colors", "point_errors"):
      known[name] = known[name].tolist()
    values["known"] = known
  (Path(folder) / _RECORD).write_text(json.dumps(values))


def load(folder: Path, images: Path) -> Capture:
  """Reads what `save` wrote; `images` is the folder that holds the keyframes."""
  values = json.loads((Path(folder) / _RECORD).read_text())
  times = values.pop("times")
  known = values.pop("known")
  if known is not None:
    known = KnownPoses(
      kind=known["kind"],
      camera=Camera(**known["camera"]),
      files=tuple(Path(path) for path in known["files"]),
      world_from_camera=np.array(known["world_from_camera"]).reshape(-1, 4, 4),
      points=np.array(known["points"], np.float64).reshape(-1, 3),
      point_colors=np.array(known["point_colors"], np.uint8).reshape(-1, 3),
      point_errors=np.array(known["point_errors"], np.float64),
    )
  names = values.pop("images")
  return Capture(
    **{
      **values,
      "sharpness": np.array(values["sharpness"]),
      "brightness": np.array(values["brightness"]),
    },
    folder=Path(images),
    images=[Path(images) / name for name in names],
    times=None if times is None else np.array(times),
    known=known,
  )
