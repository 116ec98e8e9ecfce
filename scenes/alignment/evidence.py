"""Evidence for the world frame: sparse points, cameras, dense surface, marker.

Shapes: N cameras, P sparse points, Q dense points, all in the unit frame.
"""

from typing import Generic, NamedTuple, TypeVar

import numpy as np

from nerf2real.scenes.alignment.markers import MarkerScale

T = TypeVar("T")

_MAX_DENSE = 300_000  # surface points that take part


class Evidence(NamedTuple):
  """Measurements in the unit frame, the same for floor, scale, yaw and extent."""

  points: np.ndarray  # sparse points [P, 3]
  frame_from_camera: np.ndarray  # [N, 4, 4]
  surface_points: np.ndarray | None = None  # dense: lifted depth or mesh vertices [Q, 3]
  surface_normals: np.ndarray | None = None  # theirs [Q, 3]
  marker: MarkerScale | None = None
  sensor_scale: float | None = None  # metres per unit, where depth came along
  metres_assumed: bool = False  # the sensor's unit is named nowhere
  up: np.ndarray | None = None  # roughly [3]; None: the cameras' up direction

  @property
  def positions(self) -> np.ndarray:
    """Camera centres [N, 3]."""
    return self.frame_from_camera[:, :3, 3]

  @property
  def densest(self) -> np.ndarray:
    """The dense points, or the sparse ones where there are none [., 3]."""
    return self.points if self.surface_points is None else self.surface_points

  def thinned(self) -> "Evidence":
    """Returns a random subset of the dense points where there are very many; always the same."""
    points, normals = self.surface_points, self.surface_normals
    if points is None or len(points) <= _MAX_DENSE:
      return self
    chosen = np.random.default_rng(0).choice(len(points), _MAX_DENSE, replace=False)
    return self._replace(
      surface_points=points[chosen], surface_normals=None if normals is None else normals[chosen]
    )

  def sparse(self) -> "Evidence":
    """Returns the evidence without its dense points."""
    return self._replace(surface_points=None, surface_normals=None)


class Choice(NamedTuple, Generic[T]):
  """A value that the alignment chose, with its source."""

  value: T
  source: str  # what it rests on
  warnings: tuple[str, ...] = ()
