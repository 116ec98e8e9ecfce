"""Areas of triangles, and places drawn from them.

Shapes: T triangles, N places.
"""

import numpy as np


def areas(triangles: np.ndarray) -> np.ndarray:
  """Returns the areas [T] of triangles [T, 3, 3]."""
  sides = triangles[:, 1:] - triangles[:, :1]
  found: np.ndarray = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1)
  return found


def draw(
  rng: np.random.Generator, triangles: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
  """Returns places [N, 3], uniform by area of triangles [T, 3, 3], and the triangle of each [N]."""
  area = areas(triangles)
  chosen = rng.choice(len(triangles), count, p=area / area.sum())
  a, b = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
  corner = triangles[chosen]
  return (1 - a) * corner[:, 0] + a * (1 - b) * corner[:, 1] + a * b * corner[:, 2], chosen
