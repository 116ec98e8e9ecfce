"""Exposure and white balance of every picture, from the points that several pictures see.

A phone changes its exposure while it films. The colour of a scene point in picture k is modelled as
gain_k * colour, a channel; gains and colours are fitted together, robustly, in the logarithm.

Shapes: N pictures, P points, M observations.
"""

import cv2
import numpy as np
import scipy.sparse

from nerf2real.scenes.colmap import pycolmap

_SMOOTHING = (
  2.0  # deviation of a colour's Gaussian [pixel]; chosen: hides a pixel's reprojection error
)
_DARKEST, _BRIGHTEST = 12.0, 243.0  # chosen: 5 % off the ends, where a value is noise or clipped
_ROUNDS = 12  # of reweighting; chosen: the gains move by less than 1e-3 after 8
_CORE = 0.03  # log residuals below this count quadratically; chosen: 7 levels of noise at 243
_PRIOR = 0.1  # a gain is pulled to 1 as by so many observations; chosen: matters without any only
_NOTICEABLE = 0.02  # spread of the log gains of a fixed exposure; chosen: less than can be seen
_CLIPPING = (235.0, 255.0)  # a value stays bright from here on; chosen: beyond the fit's range


def point_colors(
  model: pycolmap.Reconstruction, names: tuple[str, ...], images: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Looks the model's points up in the pictures that see them.

  Args:
    model: Points with the pictures that see them.
    names: The pictures' names [N].
    images: uint8 [N, H, W, 3], of the camera's size or smaller.

  Returns:
    picture [M], point [M] and colour float32 [M, 3] of every observation.
  """
  camera = next(iter(model.cameras.values()))
  height, width = images.shape[1:3]
  scale = np.array([width / camera.width, height / camera.height])
  index = {name: k for k, name in enumerate(names)}
  pictures, points, colors = [], [], []
  for image in model.images.values():
    k = index.get(image.name)
    if k is None:
      continue
    seen = [(p.point3D_id, p.xy) for p in image.points2D if p.has_point3D()]
    if not seen:
      continue
    place = (np.stack([xy for _, xy in seen]) * scale - 0.5).astype(np.float32)
    smooth = cv2.GaussianBlur(images[k], (0, 0), _SMOOTHING)
    looked = cv2.remap(
      smooth.astype(np.float32),
      place[:, :1],
      place[:, 1:],
      cv2.INTER_LINEAR,
      borderMode=cv2.BORDER_REPLICATE,
    )
    colors.append(looked[:, 0])
    pictures.append(np.full(len(seen), k))
    points.append(np.array([identity for identity, _ in seen]))
  if not pictures:
    return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3), np.float32)
  return np.concatenate(pictures), np.concatenate(points), np.concatenate(colors)


def picture_gains(
  pictures: np.ndarray, points: np.ndarray, colors: np.ndarray, *, count: int
) -> np.ndarray:
  """Fits a gain a picture and channel.

  Args:
    pictures, points: Index of the picture and identity of the point of every observation [M].
    colors: What the picture shows there [M, 3], in [0, 255].
    count: Number of pictures, N.

  Returns:
    Gains float64 [N, 3], their geometric mean 1; all exactly 1 where the exposure is fixed.
  """
  usable = (colors.min(-1, initial=255.0) > _DARKEST) & (colors.max(-1, initial=0.0) < _BRIGHTEST)
  pictures, values = pictures[usable], np.log(colors[usable].astype(np.float64))
  if not len(pictures):
    return np.ones((count, 3))
  _, points = np.unique(points[usable], return_inverse=True)
  logs = np.stack(
    [_fit(pictures, points, values[:, channel], count) for channel in range(3)], axis=-1
  )
  logs -= logs.mean(0)
  return np.ones((count, 3)) if logs.std(0).max() < _NOTICEABLE else np.exp(logs)


def _fit(pictures: np.ndarray, points: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
  """Log gains [N] that minimise sum |value - gain - point's mean|, by reweighted least squares."""
  weights = np.ones(len(values))
  num_points = points.max() + 1
  gains = np.zeros(count)
  for _ in range(_ROUNDS):
    table = scipy.sparse.csr_matrix((weights, (points, pictures)), shape=(num_points, count))
    total = np.asarray(table.sum(1)).ravel()
    weighted = np.bincount(points, weights * values, num_points)
    # The points' means are eliminated (Schur complement); what is left is one row a picture.
    share = scipy.sparse.diags(1 / total) @ table
    matrix = np.diag(np.asarray(table.sum(0)).ravel() + _PRIOR) - (table.T @ share).toarray()
    right = np.bincount(pictures, weights * values, count) - share.T @ weighted
    gains = np.linalg.solve(matrix, right)
    means = (weighted - table @ gains) / total
    residuals = values - gains[pictures] - means[points]
    weights = 1 / np.maximum(np.abs(residuals), _CORE) * _CORE
  return gains


def exposure_ratio(gains: np.ndarray | None) -> float:
  """How many times as bright the brightest pictures are as the darkest: 95th to 5th percentile."""
  if gains is None:
    return 1.0
  low, high = np.percentile(gains.mean(-1), [5, 95])
  return float(high / low)


def even_out(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
  """Returns a picture uint8 [H, W, 3] as it would be with gain 1; clipped values stay bright."""
  values = image.astype(np.float32)
  low, high = _CLIPPING
  clipped = np.clip((values - low) / (high - low), 0, 1) * 255
  return np.clip(np.rint(np.maximum(values / gain.astype(np.float32), clipped)), 0, 255).astype(
    np.uint8
  )


def expose(image: np.ndarray, gain: np.ndarray) -> np.ndarray:
  """Returns a picture uint8 [H, W, 3] of gain 1 as a camera with this gain shows it."""
  return np.clip(np.rint(image.astype(np.float32) * gain), 0, 255).astype(np.uint8)
