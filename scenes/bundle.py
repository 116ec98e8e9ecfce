"""The scene bundle: a folder that holds everything a simulation of the room needs.

Contents: scene.json, sfm/ (COLMAP model), field.safetensors, collision/part_*.obj, visual.glb,
free_space.pgm and .yaml (ROS map_server), report.html. `scene.json` is written last: a folder
without it is no bundle.
"""

import dataclasses
import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.serialization import from_plain, write_json
from nerf2real.scenes.alignment.marker_place import MarkerPlace
from nerf2real.scenes.geometry import map_server
from nerf2real.scenes.geometry.free_space import FreeSpaceMap

FORMAT = "scene-bundle"
FORMAT_VERSION = 1
STAGES = ".stages"  # folder of the cached stages inside a bundle that was made here
BUILT_IN = Path(__file__).parent / "data" / "room"  # the room that is shipped with the project


class BundleError(ValueError):
  """A folder is not a whole bundle; the message is one line for the user."""


@dataclasses.dataclass(frozen=True)
class Bundle:
  """A scene bundle on disk; the world frame is metric, z up, with the floor at z = 0."""

  folder: Path
  scene: Mapping[str, Any]
  """The content of scene.json."""

  @classmethod
  def load(cls, folder: Path | str | None = None) -> "Bundle":
    """Opens a bundle and checks that it is whole.

    Args:
      folder: The bundle's folder; None is the built-in room.

    Raises:
      BundleError: The folder is missing, damaged or of another format version.
    """
    folder = BUILT_IN if folder is None else Path(folder)
    if not folder.is_dir():
      raise BundleError(
        f"{folder} is not a folder: give a scene bundle, as launch/make_scene.py writes it."
      )
    path = folder / "scene.json"
    if not path.is_file():
      raise BundleError(
        f"{folder} has no scene.json, so it is no whole scene bundle: run launch/make_scene.py "
        "with it as --out again, it continues where it stopped."
      )
    try:
      scene = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
      raise BundleError(f"{path} is damaged ({error}): make the bundle again.") from error
    found = (scene.get("format"), scene.get("format_version")) if isinstance(scene, dict) else None
    if found != (FORMAT, FORMAT_VERSION):
      raise BundleError(
        f"{path} has format {found}, expected {(FORMAT, FORMAT_VERSION)}: make the bundle again "
        "with this version."
      )
    missing = [
      key
      for key in ("world_from_unit", "extent", "goals", "camera", "collision_parts")
      if key not in scene
    ]
    if missing:
      raise BundleError(f"{path} lacks {', '.join(missing)}: make the bundle again.")
    bundle = cls(folder, scene)
    files = [bundle.field_path, bundle.free_space_path, *bundle.collision_parts]
    absent = [str(file.relative_to(folder)) for file in files if not file.is_file()]
    if absent:
      raise BundleError(
        f"{folder} lacks {', '.join(absent[:3])}{' and more' if len(absent) > 3 else ''}: the "
        "bundle is damaged, make it again."
      )
    return bundle

  @property
  def name(self) -> str:
    """The scene's name."""
    return str(self.scene.get("name", self.folder.name))

  @property
  def field_path(self) -> Path:
    """The radiance field, in the unit frame."""
    return self.folder / "field.safetensors"

  @property
  def collision_parts(self) -> list[Path]:
    """The convex parts as Wavefront files in the world frame [m]."""
    return [self.folder / "collision" / name for name in self.scene["collision_parts"]]

  @property
  def keyframes_folder(self) -> Path:
    """The capture's keyframes; it exists only where the bundle was made."""
    return self.folder / STAGES / "keyframes" / "images"

  @property
  def visual_path(self) -> Path:
    """The coloured surface mesh in the world frame."""
    return self.folder / "visual.glb"

  @property
  def free_space_path(self) -> Path:
    """The map of the free floor (ROS map_server's YAML)."""
    return self.folder / "free_space.yaml"

  @property
  def world_from_unit(self) -> Similarity:
    """Maps the field's frame to the world."""
    return from_plain(self.scene["world_from_unit"], Similarity)

  @property
  def marker(self) -> MarkerPlace | None:
    """Where a marker lies in the world, which places in the room are measured from."""
    place = self.scene.get("alignment", {}).get("marker")
    return None if place is None else from_plain(place, MarkerPlace)

  @property
  def extent(self) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the scene [3] each, in the world [m]."""
    return np.array(self.scene["extent"]["lower"]), np.array(self.scene["extent"]["upper"])

  @property
  def views(self) -> tuple[np.ndarray, np.ndarray] | None:
    """Where the capture's pictures were taken [N, 3] [m] and their optical axes [N, 3], world.

    None in a bundle of an older version, which lacks them.
    """
    found = self.scene.get("views")
    return None if found is None else (np.array(found["position"]), np.array(found["axis"]))

  @property
  def goals(self) -> np.ndarray:
    """Goal positions (x, y) on the floor [G, 2] [m]."""
    return np.array(self.scene["goals"], np.float64).reshape(-1, 2)

  @functools.cached_property
  def free_space(self) -> FreeSpaceMap:
    """The free floor area."""
    return map_server.read(self.free_space_path)

  @property
  def figures(self) -> Mapping[str, Any]:
    """The measured quality figures."""
    return self.scene.get("figures", {})


def write_scene(folder: Path, scene: Mapping[str, Any]) -> None:
  """Writes scene.json, the last file of a bundle."""
  content = {"format": FORMAT, "format_version": FORMAT_VERSION, **scene}
  write_json(Path(folder) / "scene.json", content)
