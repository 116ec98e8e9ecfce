"""Chooses what pictures a picture is compared with: those that see its points from beside it.

Shapes: N pictures, A points.
"""

import dataclasses

import numpy as np

from nerf2real.scenes.field.views import Views


@dataclasses.dataclass(frozen=True, kw_only=True)
class NeighbourSettings:
  """Settings of the choice; chosen, not tuned."""

  most: int = 5
  """Of each picture."""
  least_angle: float = 0.05
  """Between two pictures' sight lines to a point [rad]: with less its depth is uncertain."""
  most_angle: float = 0.6
  """With more patches look too different."""


def neighbours(views: Views, settings: NeighbourSettings) -> list[np.ndarray]:
  """Lists each picture's neighbours int [<= most], those first that see most of its anchors."""
  camera, eyes = views.camera, views.world_from_camera[:, :3, 3]
  size = np.array([camera.width, camera.height])
  owner = views.anchors[:, 0].astype(int)
  x, y = views.anchors[:, 1:3].astype(int).T
  every = camera.rays()
  widest = np.square(every[..., :2]).sum(-1).max()  # farther out a lens may fold back
  rays = every[y, x]
  ways = np.einsum("aij,aj->ai", views.world_from_camera[owner, :3, :3], rays)
  ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
  points = eyes[owner] + views.anchors[:, 3:] * ways
  found = []
  for n in range(len(views)):
    mine, way = points[owner == n], ways[owner == n]
    scores = np.zeros(len(views), int)
    for k, pose in enumerate(views.world_from_camera):
      if k == n or pose[:3, 2] @ views.world_from_camera[n, :3, 2] <= 0:
        continue
      offset = mine - eyes[k]
      local = offset @ pose[:3, :3]
      ahead = np.square(local[:, :2]).sum(-1) < widest * np.square(np.maximum(local[:, 2], 0))
      pixel = camera.project(np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
      cosine = (offset * way).sum(-1) / np.maximum(np.linalg.norm(offset, axis=-1), 1e-12)
      angle = np.arccos(np.clip(cosine, -1, 1))
      seen = ahead & ((pixel >= 0) & (pixel < size)).all(-1)
      scores[k] = (seen & (angle > settings.least_angle) & (angle < settings.most_angle)).sum()
    order = np.argsort(-scores, kind="stable")[: settings.most]
    found.append(order[scores[order] > 0])
  return found
