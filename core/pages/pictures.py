"""Pictures of reports: embedding, thumbnails, colouring of errors and depths.

Shapes: H height, W width.
"""

import base64

import cv2
import numpy as np

_JPEG_QUALITY = 88
_FULL_SCALE = 64  # of 255: the error that is brightest
_FAR = 98.0  # percentile of the depth that is darkest; few pixels lie far behind


def data_uri(image: np.ndarray, *, lossless: bool) -> str:
  """Returns a picture, RGB uint8 [H, W, 3] or grey [H, W], as a data URI: JPEG, or PNG."""
  channels = image[..., ::-1] if image.ndim == 3 else image
  if lossless:
    _, data = cv2.imencode(".png", channels)
  else:
    _, data = cv2.imencode(".jpg", channels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
  encoded = base64.b64encode(data.tobytes()).decode()
  return f"data:image/{'png' if lossless else 'jpeg'};base64,{encoded}"


def shrink(image: np.ndarray, width: int) -> np.ndarray:
  """Returns a picture [H, W, ...] of at most a width, with its proportions."""
  if image.shape[1] <= width:
    return image
  height = round(image.shape[0] * width / image.shape[1])
  return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def error_map(truth: np.ndarray, image: np.ndarray) -> np.ndarray:
  """Colours the absolute difference of two pictures [H, W, 3]; 64 of 255 is brightest."""
  difference = np.abs(truth.astype(np.int16) - image).mean(-1) * (255.0 / _FULL_SCALE)
  levels = np.clip(difference, 0, 255).astype(np.uint8)
  return cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1]


def depth_map(depth: np.ndarray) -> np.ndarray:
  """Colours a depth picture [H, W], near is bright; black where nothing was hit."""
  hit = np.isfinite(depth)
  if not hit.any():
    return np.zeros((*depth.shape, 3), np.uint8)
  far = np.percentile(depth[hit], _FAR)
  levels = np.where(hit, 255 * (1 - np.clip(depth / max(far, 1e-9), 0, 1)), 0).astype(np.uint8)
  colored = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1].copy()
  colored[~hit] = 0
  return colored
