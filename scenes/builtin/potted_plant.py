"""The large potted plant of the built-in room."""

import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry import rotations
from nerf2real.scenes.builtin.placing import ROOM_SIZE, Group
from nerf2real.scenes.builtin.solids import Solid


def plant(rng: np.random.Generator) -> list[Solid]:
  """Returns a large potted plant in the north-east corner: pot, soil, stems and leaves."""
  base = np.array([2.13, 1.62, 0.0])
  group = Group("plant", base)
  group.add("cone", (0.19, 0.25, 0.2), (0, 0, 0.2), "glaze", tiles=1.0, tint=(1.0, 0.72, 0.6))
  group.add("cone", (0.265, 0.265, 0.022), (0, 0, 0.395), "glaze", tiles=1.0, tint=(1.0, 0.7, 0.58))
  group.add("cone", (0.235, 0.235, 0.01), (0, 0, 0.415), "soil", tiles=2.0)
  for _ in range(9):
    foot = np.array([*rng.uniform(-0.08, 0.08, 2), 0.42])
    lean, azimuth = rng.uniform(0.05, 0.38), rng.uniform(0, 2 * np.pi)
    direction = np.array([np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), 1.0])
    length = rng.uniform(0.55, 1.3)
    direction /= np.linalg.norm(direction)
    turn = rotations.shortest_rotation(np.array([0.0, 0.0, 1.0]), direction)
    middle = foot + 0.5 * length * direction
    group.add("cone", (0.013, 0.008, length / 2), middle, "leaf", rotation=turn, tiles=1.0)
    for along in np.arange(0.25, 1.01, 0.11):
      start = foot + along * length * direction
      _leaf(group, rng, base, start)
  return group.solids


def _leaf(group: Group, rng, base: np.ndarray, start: np.ndarray) -> None:
  """Adds an arching leaf of two blades, unless no tried direction keeps it inside the room."""
  for _ in range(12):
    azimuth, pitch = rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.7)
    length, width = rng.uniform(0.17, 0.29), rng.uniform(0.045, 0.075)
    tint = tuple(rng.uniform(0.75, 1.15) * np.array([1.0, 1.0, 0.9]))
    blades, tip = [], start
    for droop in (0.0, 0.55):
      rotation = Rotation.from_euler("zyx", [azimuth, -(pitch - droop), rng.normal(0, 0.3)])
      rotation = rotation.as_matrix()
      half = 0.55 * length * (1.0 if droop == 0 else 0.8)
      blades.append((tip + 0.85 * half * rotation[:, 0], rotation, half))
      tip = tip + 1.5 * half * rotation[:, 0]
    ends = np.stack([base + tip, base + start])
    limit = np.array(ROOM_SIZE[:2]) / 2 - 0.06
    if (np.abs(ends[:, :2]) < limit).all() and ends[:, 2].min() > 0.55:
      for centre, rotation, half in blades:
        size = (half, width, 0.004)
        group.add("ellipsoid", size, centre, "leaf", rotation=rotation, tiles=None, tint=tint)
      return
