"""Opens the capture that a scene is made of: its kind, its hash, and whether --out is for it."""

import json
from pathlib import Path

from nerf2real.core import files
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.capture.posed.colmap_model import read_colmap
from nerf2real.scenes.capture.posed.transforms import read_transforms
from nerf2real.scenes.stages.results import Source

_LISTS_PICTURES = {"colmap": read_colmap, "transforms": read_transforms}
"""Readers of kinds whose pictures may lie beside the source."""


def open_source(path: Path, out: Path) -> Source:
  """Returns a capture with its hash, which is also that of the pictures that it names.

  Args:
    path: As for `pipeline.make_scene`.
    out: The folder of the bundle that is made of it.

  Raises:
    CaptureError: The source cannot become a capture; the message is one line.
    ValueError: The folder lies in the source, or holds a scene of another capture.
  """
  kind = source_kind(path)
  if path.is_dir() and out.resolve().is_relative_to(path.resolve()):
    raise ValueError(
      f"--out {out} lies in the capture {path}, which it would change: name a folder beside it."
    )
  named: list[Path] = []
  if kind in _LISTS_PICTURES:
    known = _LISTS_PICTURES[kind](path)
    named += [*known.files, *known.depth_files]
  film = Source(path, files.hash_path(path, named=named))
  _check_owner(out, film)
  return film


def _check_owner(out: Path, film: Source) -> None:
  """Raises ValueError where a folder holds a scene of a capture of another name and content."""
  try:
    made_from = json.loads((out / "scene.json").read_text())["source"]
    name, sha256 = made_from["name"], made_from["sha256"]
  except (OSError, ValueError, KeyError, TypeError):
    return  # none yet, or a damaged one, which is made again
  if name != film.path.name and sha256 != film.sha256:
    raise ValueError(
      f"{out} holds a scene of {name}, found the capture {film.path.name}: name another folder "
      "with --out, or remove that one."
    )
