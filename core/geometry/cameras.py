"""The OPENCV camera model (pinhole with radial and tangential distortion).

Pixel coordinates follow COLMAP: the centre of the upper left pixel is (0.5, 0.5). Camera axes
follow OpenCV: x right, y down, z forward. Shapes: H height, W width.

OpenCV's functions and ROS's messages have that centre at (0, 0) instead: `PIXEL_CENTRE` is added to
what they return, and to nothing else.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

PIXEL_CENTRE = 0.5  # of the upper left pixel, here and in COLMAP, against OpenCV's and ROS's 0
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")  # what a calibration finds, COLMAP's order
_UNDISTORT_ITERATIONS = 20  # Newton steps; converges in fewer than 10 for lenses of phones


@dataclasses.dataclass(frozen=True, kw_only=True)
class Camera:
  """An OPENCV camera.

  Source: OpenCV documentation, calib3d, equations of the distortion model; COLMAP's model OPENCV.
  """

  width: int
  """Picture width [pixel]."""
  height: int
  """Picture height [pixel]."""
  fx: float
  """Focal length along x [pixel]."""
  fy: float
  """Focal length along y [pixel]."""
  cx: float
  """Principal point, x [pixel]."""
  cy: float
  """Principal point, y [pixel]."""
  k1: float = 0.0
  """Radial distortion, second order."""
  k2: float = 0.0
  """Radial distortion, fourth order."""
  p1: float = 0.0
  """Tangential distortion."""
  p2: float = 0.0
  """Tangential distortion."""

  def __post_init__(self):
    if self.width < 1 or self.height < 1:
      raise ValueError(
        f"A camera needs a picture of at least 1x1 pixel, found {self.width}x{self.height}."
      )
    if not (self.fx > 0 and self.fy > 0):
      raise ValueError(f"Focal lengths must be positive, found fx={self.fx}, fy={self.fy}.")

  @property
  def matrix(self) -> np.ndarray:
    """The intrinsic matrix [3, 3]."""
    return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

  @property
  def distortion(self) -> np.ndarray:
    """The coefficients k1, k2, p1, p2 [4], in OpenCV's order."""
    return np.array([self.k1, self.k2, self.p1, self.p2], np.float64)

  @property
  def lens(self) -> tuple[float, ...]:
    """The eight numbers of `LENS`."""
    return tuple(float(getattr(self, name)) for name in LENS)

  @property
  def opencv_matrix(self) -> np.ndarray:
    """The intrinsic matrix [3, 3] for OpenCV and ROS, whose first pixel's centre is at (0, 0)."""
    matrix = self.matrix
    matrix[:2, 2] -= PIXEL_CENTRE
    return matrix

  @property
  def vertical_fov(self) -> float:
    """The vertical field of view without distortion [rad]; MuJoCo's fovy, in rad."""
    return float(2 * np.arctan(0.5 * self.height / self.fy))

  @property
  def pixel_angle(self) -> float:
    """The mean angle that one pixel spans at the picture's centre [rad]."""
    return 2.0 / (self.fx + self.fy)

  def resized(self, width: int, height: int) -> "Camera":
    """Returns this camera with its picture resampled to another size."""
    sx, sy = width / self.width, height / self.height
    return dataclasses.replace(
      self,
      width=width,
      height=height,
      fx=self.fx * sx,
      fy=self.fy * sy,
      cx=self.cx * sx,
      cy=self.cy * sy,
    )

  def at_most(self, width: int) -> "Camera":
    """Returns this camera with its picture reduced to a width if it is wider [pixel]."""
    width = min(width, self.width)
    return self.resized(width, round(self.height * width / self.width))

  def size_ratio(self, other: "Camera") -> np.ndarray:
    """Returns what pixels [..., 2] of another size of this picture are multiplied with [2]."""
    return np.array([self.width / other.width, self.height / other.height])

  def distort(self, points: np.ndarray) -> np.ndarray:
    """Maps ideal image-plane points (x/z, y/z) [..., 2] to distorted ones [..., 2]."""
    x, y = points[..., 0], points[..., 1]
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1 + self.k1 * r2 + self.k2 * r2 * r2
    return np.stack(
      [
        x * radial + 2 * self.p1 * xy + self.p2 * (r2 + 2 * xx),
        y * radial + self.p1 * (r2 + 2 * yy) + 2 * self.p2 * xy,
      ],
      axis=-1,
    )

  def undistort(self, points: np.ndarray) -> np.ndarray:
    """Inverts `distort` by Newton's method: distorted [..., 2] to ideal points [..., 2]."""
    target = np.asarray(points, np.float64)
    ideal = target.copy()
    for _ in range(_UNDISTORT_ITERATIONS):
      x, y = ideal[..., 0], ideal[..., 1]
      r2 = x * x + y * y
      radial = 1 + self.k1 * r2 + self.k2 * r2 * r2
      slope = self.k1 + 2 * self.k2 * r2  # d radial / d r2
      a = radial + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
      b = 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
      d = radial + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
      residual = self.distort(ideal) - target
      determinant = a * d - b * b
      step = np.stack(
        [
          (d * residual[..., 0] - b * residual[..., 1]) / determinant,
          (a * residual[..., 1] - b * residual[..., 0]) / determinant,
        ],
        axis=-1,
      )
      if not step.any():  # as at once without distortion: all further steps are zero, too
        break
      ideal = ideal - step
    return ideal

  def project(self, points: np.ndarray) -> np.ndarray:
    """Projects points in the camera frame [..., 3] to pixels [..., 2]; z must be positive."""
    points = np.asarray(points, np.float64)
    plane = self.distort(points[..., :2] / points[..., 2:])
    return plane * [self.fx, self.fy] + [self.cx, self.cy]

  def pixel_centres(self) -> np.ndarray:
    """Returns the coordinates of all pixels' centres [H, W, 2]."""
    u, v = np.meshgrid(*(np.arange(n) + PIXEL_CENTRE for n in (self.width, self.height)))
    return np.stack([u, v], axis=-1)

  def rays(self, pixels: np.ndarray | None = None) -> np.ndarray:
    """Returns viewing directions with z = 1 in the camera frame.

    Args:
      pixels: Pixel coordinates [..., 2]; the centres of all pixels [H, W, 2] if None.

    Returns:
      Directions [..., 3], not normalised: a sample at parameter t has depth t.
    """
    pixels = self.pixel_centres() if pixels is None else pixels
    plane = (np.asarray(pixels, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
    ideal = self.undistort(plane)
    return np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)

  @classmethod
  def from_opencv(
    cls,
    width: int,
    height: int,
    matrix: np.ndarray | Sequence[float],
    distortion: Sequence[float],
  ) -> "Camera":
    """Returns the camera that OpenCV calibrated, or that ROS's CameraInfo describes.

    Args:
      width: Picture width [pixel].
      height: Picture height [pixel].
      matrix: Intrinsic matrix, [3, 3] or its 9 numbers row by row.
      distortion: k1, k2, p1, p2.
    """
    (fx, _, cx), (_, fy, cy), _ = np.reshape(np.asarray(matrix, np.float64), (3, 3)).tolist()
    k1, k2, p1, p2 = map(float, distortion)
    return cls(
      width=int(width),
      height=int(height),
      fx=fx,
      fy=fy,
      cx=cx + PIXEL_CENTRE,
      cy=cy + PIXEL_CENTRE,
      k1=k1,
      k2=k2,
      p1=p1,
      p2=p2,
    )

  @classmethod
  def from_vertical_fov(cls, fov: float, width: int, height: int) -> "Camera":
    """Returns an ideal pinhole camera with a vertical field of view [rad]."""
    focal = focal_length(fov, height)
    return cls(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)


def focal_length(fov: float, size: int) -> float:
  """Returns the focal length [pixel] of a field of view [rad] across a number of pixels."""
  return float(0.5 * size / np.tan(0.5 * fov))
