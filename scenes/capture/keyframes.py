"""Reads and writes the record of the keyframes, capture.json."""

import json
from pathlib import Path

from nerf2real.core.serialization import from_plain, to_plain, write_json
from nerf2real.scenes.capture.capture import Capture

_RECORD = "capture.json"


def save(taken: Capture, folder: Path) -> None:
  """Writes what is known of the keyframes beside them, into capture.json."""
  values = to_plain(taken)
  del values["folder"]
  values["images"] = [path.name for path in taken.images]
  write_json(Path(folder) / _RECORD, values, indent=None)


def load(folder: Path, images: Path) -> Capture:
  """Reads what `save` wrote; `images` is the folder that holds the keyframes."""
  record = Path(folder) / _RECORD
  values = json.loads(record.read_text())
  values["folder"] = str(images)
  values["images"] = [str(Path(images) / name) for name in values["images"]]
  return from_plain(values, Capture, source=record)
