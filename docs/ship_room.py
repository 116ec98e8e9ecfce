"""Copies a finished bundle of the built-in room to scenes/data/room, the default scene.

  python docs/ship_room.py out/room
  python docs/ship_room.py --surface  # only the surface mesh anew, of the field that is there

The report and the feature observations of the COLMAP model (most of its size) stay behind.
"""

import shutil
import sys
import tempfile
from pathlib import Path

from nerf2real.core.serialization import from_plain
from nerf2real.scenes.alignment.world_frame import Alignment
from nerf2real.scenes.bundle import BUILT_IN, Bundle
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.export import views
from nerf2real.scenes.geometry.mesh import MeshSettings
from nerf2real.scenes.poses import localisation, mapping
from nerf2real.scenes.settings import SceneSettings
from nerf2real.scenes.stages import geometry
from nerf2real.scenes.stages.cache import Made, StageResult, Stages

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


def remake_surface() -> None:
  """Replaces the default scene's surface mesh by one of its field's own depth."""
  bundle = Bundle.load(BUILT_IN)
  width = SceneSettings().depth_width
  depth = views.capture_views(bundle, views.renderer_of(bundle), width=width, count=1000)
  place = from_plain(bundle.scene["alignment"], Alignment)
  with tempfile.TemporaryDirectory() as folder:
    given = StageResult(BUILT_IN, "", "", 0.0, cached=True)
    made = geometry.surface(
      Stages(Path(folder)), Made(place, given), Made(depth, given), MeshSettings()
    )
    shutil.copyfile(made.folder / "visual.glb", bundle.visual_path)


if __name__ == "__main__":
  if sys.argv[1] == "--surface":
    remake_surface()
  else:
    main(Path(sys.argv[1]))
