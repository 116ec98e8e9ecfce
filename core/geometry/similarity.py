"""Similarity transforms of space: x -> scale * rotation @ x + translation."""

import dataclasses

import numpy as np

_TRIES = 500  # of fits to three points each
_KEPT = 2.5  # robust standard deviations within which points count (Rousseeuw and Leroy 1987)


@dataclasses.dataclass(frozen=True)
class Similarity:
  """A rotation, a uniform scale and a translation."""

  scale: float = 1.0
  rotation: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
  """[3, 3]."""
  translation: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
  """[3]."""

  def apply(self, points: np.ndarray) -> np.ndarray:
    """Maps points [..., 3]."""
    return self.scale * np.asarray(points) @ self.rotation.T + self.translation

  def apply_pose(self, frame_from_camera: np.ndarray) -> np.ndarray:
    """Maps camera poses [..., 4, 4]; the result is rigid: only the position takes the scale."""
    poses = np.array(frame_from_camera, np.float64)
    poses[..., :3, 3] = self.apply(poses[..., :3, 3])
    poses[..., :3, :3] = self.rotation @ poses[..., :3, :3]
    return poses

  @property
  def matrix(self) -> np.ndarray:
    """[3, 4], which maps homogeneous points."""
    return np.hstack([self.scale * self.rotation, self.translation[:, None]])

  def inverse(self) -> "Similarity":
    """Returns the transform that undoes this one."""
    rotation = self.rotation.T
    return Similarity(1 / self.scale, rotation, -rotation @ self.translation / self.scale)

  def __matmul__(self, other: "Similarity") -> "Similarity":
    """Composes: (a @ b).apply(x) == a.apply(b.apply(x))."""
    return Similarity(
      self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation)
    )

  @classmethod
  def fit(cls, source: np.ndarray, target: np.ndarray, *, with_scale: bool = True) -> "Similarity":
    """Least-squares similarity that maps source [N, 3] onto target [N, 3].

    Source: Umeyama 1991, Least-squares estimation of transformation parameters between two point
    patterns, equations 38 to 42.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or len(source) < 3:
      raise ValueError(
        f"Need the same number of points, at least 3, found {source.shape} and {target.shape}."
      )
    centre_s, centre_t = source.mean(0), target.mean(0)
    covariance = (target - centre_t).T @ (source - centre_s) / len(source)
    u, values, vt = np.linalg.svd(covariance)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ sign @ vt
    variance = ((source - centre_s) ** 2).sum() / len(source)
    scale = float(np.trace(np.diag(values) @ sign) / variance) if with_scale else 1.0
    return cls(scale, rotation, centre_t - scale * rotation @ centre_s)

  @classmethod
  def fit_most(
    cls, source: np.ndarray, target: np.ndarray, *, with_scale: bool = True
  ) -> "Similarity":
    """Least-squares similarity of the points of source [N, 3] and target [N, 3] that most agree on.

    Those within 2.5 robust standard deviations of the fit to three points that leaves the least
    median of squares. Source: Rousseeuw and Leroy 1987, Robust regression and outlier detection.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)

    def squares(fit: "Similarity") -> np.ndarray:
      return ((fit.apply(source) - target) ** 2).sum(axis=-1)

    best = squares(cls.fit(source, target, with_scale=with_scale))
    random = np.random.default_rng(0)
    for _ in range(_TRIES):
      rows = random.choice(len(source), 3, replace=False)
      found = squares(cls.fit(source[rows], target[rows], with_scale=with_scale))
      if np.median(found) < np.median(best):  # not so of three on a line, whose scale is no number
        best = found
    # the deviation of a normal distribution, with Rousseeuw's correction for few points
    spread = 1.4826 * (1.0 + 5.0 / max(len(source) - 3, 1)) * np.sqrt(np.median(best))
    kept = best <= max((_KEPT * spread) ** 2, np.median(best))
    return cls.fit(source[kept], target[kept], with_scale=with_scale)
