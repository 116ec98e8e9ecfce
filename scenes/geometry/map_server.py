"""Reads and writes free-space maps in ROS map_server's format: a PGM picture and a YAML.

The picture's first row is the largest y; the YAML holds resolution and lower left corner.
"""

import pathlib

import cv2
import numpy as np
import yaml

from nerf2real.scenes.geometry.free_space import FREE, OCCUPIED, UNKNOWN, FreeSpaceMap


def write(space: FreeSpaceMap, path: pathlib.Path) -> None:
  """Writes path (.pgm) and the .yaml beside it, in ROS map_server's convention."""
  height, width = space.cells.shape
  header = f"P5\n# free space for a robot of radius {space.radius:g} m\n{width} {height}\n255\n"
  path.write_bytes(header.encode("ascii") + np.ascontiguousarray(space.cells[::-1]).tobytes())
  path.with_suffix(".yaml").write_text(
    f"image: {path.name}\nmode: trinary\nresolution: {float(space.resolution)!r}\n"
    f"origin: [{float(space.origin[0])!r}, {float(space.origin[1])!r}, 0.0]\n"
    "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    f"robot_radius: {float(space.radius)!r}\n",
    encoding="ascii",
  )


def read(path: pathlib.Path) -> FreeSpaceMap:
  """Reads a map: the .yaml, or the .pgm beside it.

  Raises:
    ValueError: a missing or damaged file, or a rotated map.
  """
  path = path.with_suffix(".yaml")
  if not path.is_file():
    raise ValueError(f"The map {path} does not exist.")
  try:
    about = yaml.safe_load(path.read_text(encoding="utf-8"))
  except (yaml.YAMLError, UnicodeDecodeError) as error:
    reason = " ".join(str(error).split())
    message = f"The map {path} is no YAML file ({reason}): make the bundle again."
    raise ValueError(message) from error
  if not isinstance(about, dict):
    raise ValueError(f"The map {path} holds {about!r}; expected names and values.")
  missing = {"image", "resolution", "origin"} - set(about)
  if missing:
    raise ValueError(f"The map {path} lacks {', '.join(sorted(missing))}.")
  if len(about["origin"]) > 2 and about["origin"][2]:
    raise ValueError(f"The map {path} is turned by {about['origin'][2]} rad; expected 0.")
  image = cv2.imread(str(path.parent / about["image"]), cv2.IMREAD_GRAYSCALE)
  if image is None:
    raise ValueError(f"Cannot read the map's picture {path.parent / about['image']}.")
  share = image / 255.0 if about.get("negate") else 1 - image / 255.0
  cells = np.full(image.shape, UNKNOWN, np.uint8)
  cells[share > about.get("occupied_thresh", 0.65)] = OCCUPIED
  cells[share < about.get("free_thresh", 0.196)] = FREE
  return FreeSpaceMap(
    cells=cells[::-1].copy(),
    resolution=float(about["resolution"]),
    origin=np.array(about["origin"][:2], np.float64),
    radius=float(about.get("robot_radius", 0.0)),
  )
