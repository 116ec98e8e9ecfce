"""Copies a finished bundle of the built-in room to scenes/data/room, the default scene.

  python docs/ship_room.py out/room

The report and the feature observations of the COLMAP model (most of its size) stay behind.
"""

import shutil
import sys
from pathlib import Path

from nerf2real.scenes.bundle import BUILT_IN, Bundle
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.poses import localisation, mapping

_ITEMS = ("collision", "field.safetensors", "visual.glb", "free_space.pgm", "free_space.yaml")


def main(folder: Path) -> None:
  """Replaces the default scene."""
  bundle = Bundle.load(folder)
  shutil.rmtree(BUILT_IN, ignore_errors=True)
  BUILT_IN.mkdir(parents=True)
  for item in _ITEMS:
    source = bundle.folder / item
    (shutil.copytree if source.is_dir() else shutil.copyfile)(source, BUILT_IN / item)
  found = localisation.load(bundle.folder / "sfm")
  known = KnownPoses(
    kind="colmap",
    camera=found.camera,
    files=tuple(Path(name) for name in found.names),
    world_from_camera=found.world_from_camera,
    points=found.points,
    point_colors=found.point_colors,
    point_errors=found.point_errors,
  )
  (BUILT_IN / "sfm").mkdir()
  mapping.model_from_poses(known, list(found.names)).write(str(BUILT_IN / "sfm"))
  shutil.copyfile(bundle.folder / "sfm" / "localisation.json", BUILT_IN / "sfm/localisation.json")
  shutil.copyfile(bundle.folder / "scene.json", BUILT_IN / "scene.json")
  Bundle.load(BUILT_IN)
  size = sum(path.stat().st_size for path in BUILT_IN.rglob("*") if path.is_file())
  print(f"{BUILT_IN}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
  main(Path(sys.argv[1]))
