"""Writes the convex parts as a height map: PNG and an MJCF `hfield` that reads it.

A height map keeps the upper face of matter only: what a robot could pass under becomes solid, so
matter that begins above a clearance is left out.
"""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from nerf2real.core import files
from nerf2real.core.picture_files import write_picture
from nerf2real.scenes.geometry import collision, convex

PICTURE = "heightfield.png"
_BASE = 0.1  # thickness of the field below its lowest point [m]


def heights(
  parts: Sequence[convex.Part],
  extent: tuple[np.ndarray, np.ndarray],
  *,
  resolution: float = 0.02,
  clearance: float = 0.6,
) -> np.ndarray:
  """Height [H, W] [m] of the topmost matter in each cell that starts below a clearance.

  Args:
    parts: Convex parts, world frame.
    extent: Lower and upper corner [>= 2] of the map [m].
    resolution: Edge of a cell [m]; rows go along +y, columns along +x.
    clearance: Matter whose lower face is higher passes overhead [m]; the OP3 is 0.51 m tall.
  """
  model = collision.spec(parts).compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  lower, upper = (np.asarray(corner, np.float64)[:2] for corner in extent)
  columns, rows = np.maximum(np.round((upper - lower) / resolution).astype(int), 2)
  x = np.linspace(lower[0], upper[0], columns)  # MuJoCo's samples include both borders
  y = np.linspace(lower[1], upper[1], rows)
  top = 1.0 + max((float(part.vertices[:, 2].max()) for part in parts), default=0.0)
  found = np.zeros((rows, columns))
  geom = np.zeros(1, np.int32)
  tops = np.array([part.vertices[:, 2].max() for part in parts])
  overhead = np.array([part.vertices[:, 2].min() > clearance for part in parts])
  model.geom_group[1:][overhead] = 5
  seen = np.array([1, 1, 1, 1, 1, 0], np.uint8)
  for row, column in np.ndindex(rows, columns):
    start = np.array([x[column], y[row], top])
    reach = mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), seen, 1, -1, geom)
    if geom[0] > 0:
      found[row, column] = min(max(top - reach, 0.0), tops[geom[0] - 1])
  return found


def write(
  folder: Path, height: np.ndarray, extent: tuple[np.ndarray, np.ndarray], *, name: str
) -> None:
  """Writes heightfield.png (8 bit grey, top row at the largest y) and scene.xml.

  A grey level is 1/255 of the highest point, which scene.xml names; MuJoCo reads 8 bits.

  Raises:
    ValueError: The map is flat, which MuJoCo cannot scale.
  """
  highest = float(height.max())
  if highest <= 0:
    raise ValueError("Found no matter above the floor: a height map needs at least one part.")
  lower, upper = (np.asarray(corner, np.float64)[:2] for corner in extent)
  half, center = (upper - lower) / 2, (upper + lower) / 2
  spec = mujoco.MjSpec()
  spec.modelname = name
  spec.stat.center, spec.stat.extent = [*center, 0.5], float(half.max())
  spec.add_hfield(name="scene", file=PICTURE, size=[*half, highest, _BASE])
  spec.worldbody.add_light(pos=[*center, 3.0], dir=[0, 0, -1])
  spec.worldbody.add_geom(
    name="scene", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="scene", pos=[*center, 0]
  )
  with files.atomic_folder(folder) as partial:
    grey = np.round(255 * height[::-1] / highest).astype(np.uint8)
    write_picture(partial / PICTURE, grey)
    spec.modelfiledir = str(partial)
    spec.compile()
    (partial / "scene.xml").write_text(spec.to_xml(), encoding="utf-8")
