"""Renders a MuJoCo model through any OPENCV camera, with area-averaged pixels.

A larger pinhole picture is rendered, sampled where the lens looks, and averaged over each pixel.
"""

import dataclasses
import os

import cv2
import mujoco
import numpy as np

from nerf2real.core.geometry.cameras import PIXEL_CENTRE, Camera
from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV

MAX_WIDTH, MAX_HEIGHT = 2560, 2048  # of the pinhole picture [pixel]; the model's offscreen buffer
_EGL_PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri"


def _context_class():
  """EGL unless the environment names another way, whoever imported mujoco first."""
  if os.environ.get("MUJOCO_GL", "egl").lower() != "egl":
    return mujoco.GLContext
  from mujoco.egl import GLContext  # here: where EGL is missing, this import itself fails

  return GLContext


class EglMissingError(RuntimeError):
  """No OpenGL context can be made without a display."""


@dataclasses.dataclass(frozen=True)
class _Lens:
  """The pinhole picture that covers an OPENCV camera's view, and where to sample it."""

  width: int
  height: int
  tan_x: float
  """Half the pinhole picture's extent at z = 1."""
  tan_y: float
  maps: tuple[np.ndarray, np.ndarray]
  """For cv2.remap, one sample a sub-pixel."""
  depth_maps: tuple[np.ndarray, np.ndarray]
  """One sample a pixel."""


def _sampling(camera: Camera, lens_size, factor: int) -> tuple[np.ndarray, np.ndarray]:
  width, height, tan_x, tan_y = lens_size
  u = (np.arange(camera.width * factor) + PIXEL_CENTRE) / factor
  v = (np.arange(camera.height * factor) + PIXEL_CENTRE) / factor
  plane = camera.rays(np.stack(np.meshgrid(u, v), -1))[..., :2]
  x = (plane[..., 0] / tan_x + 1) * width / 2 - PIXEL_CENTRE
  y = (plane[..., 1] / tan_y + 1) * height / 2 - PIXEL_CENTRE
  return x.astype(np.float32), y.astype(np.float32)


def _lens(camera: Camera, supersample: int) -> _Lens:
  u, v = np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)
  rim = [np.stack(np.broadcast_arrays(u, y), -1) for y in (0.0, camera.height)]
  rim += [np.stack(np.broadcast_arrays(x, v), -1) for x in (0.0, camera.width)]
  plane = np.abs(camera.rays(np.concatenate(rim))[:, :2]).max(0) * 1.004
  density = supersample * np.array([camera.fx, camera.fy])
  size = np.ceil(2 * plane * density).astype(int)
  size = np.minimum(size, [MAX_WIDTH, MAX_HEIGHT])
  width, height = int(size[0]), int(size[1])
  geometry = (width, height, float(plane[0]), float(plane[1]))
  maps = cv2.convertMaps(*_sampling(camera, geometry, supersample), cv2.CV_16SC2)
  return _Lens(*geometry, maps, _sampling(camera, geometry, 1))


class Eye:
  """Renders a compiled model; close it after use (it holds an OpenGL context)."""

  def __init__(self, model: mujoco.MjModel, *, groups: tuple[int, ...] = (0, 1, 2)):
    """Makes the OpenGL context.

    Args:
      model: The compiled model.
      groups: Geom groups that are drawn.

    Raises:
      EglMissingError: No EGL; the message names the packages to install.
    """
    try:
      self._gl = _context_class()(MAX_WIDTH, MAX_HEIGHT)
      self._gl.make_current()
    except Exception as error:  # the library raises many kinds, AttributeError among them
      raise EglMissingError(
        f"No OpenGL context could be made for rendering ({type(error).__name__}: {error}). "
        f"Expected EGL. On Debian or Ubuntu: apt-get install {_EGL_PACKAGES}, "
        "and set MUJOCO_GL=egl before Python starts."
      ) from error
    self._model = model
    self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
    self._scene = mujoco.MjvScene(model, maxgeom=4 * model.ngeom + 100)
    for flag in ("SHADOW", "REFLECTION", "SKYBOX", "HAZE", "FOG"):
      self._scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
    self._options = mujoco.MjvOption()
    self._options.geomgroup[:] = [int(g in groups) for g in range(6)]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    self.update(data)
    self._lenses: dict[tuple[Camera, int], _Lens] = {}

  def update(self, data: mujoco.MjData) -> None:
    """Takes over the places of all bodies."""
    mujoco.mjv_updateScene(
      self._model,
      data,
      self._options,
      None,
      mujoco.MjvCamera(),
      mujoco.mjtCatBit.mjCAT_ALL,
      self._scene,
    )

  def render(self, camera: Camera, world_from_camera: np.ndarray, *, supersample: int):
    """Renders one picture.

    Args:
      camera: The lens.
      world_from_camera: Pose [4, 4], OpenCV axes.
      supersample: Samples per pixel along each side S.

    Returns:
      The mean colour of each pixel, uint8 [H, W, 3], and the z-depth at the pixel's centre, float32
      [H, W] [m].
    """
    key = (camera, supersample)
    if key not in self._lenses:
      self._lenses[key] = _lens(camera, supersample)
    lens = self._lenses[key]
    color, depth = self._pinhole(lens, world_from_camera)
    sampled = cv2.remap(color, *lens.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    size = (camera.width, camera.height)
    picture = cv2.resize(sampled, size, interpolation=cv2.INTER_AREA)
    nearest = cv2.remap(depth, *lens.depth_maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return picture, nearest

  def _pinhole(self, lens: _Lens, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    near, far = (float(v) * self._model.stat.extent for v in self._planes)
    rotation = np.asarray(pose)[:3, :3] @ OPENGL_FROM_OPENCV
    for eye in self._scene.camera:
      eye.pos, eye.up, eye.forward = np.asarray(pose)[:3, 3], rotation[:, 1], -rotation[:, 2]
      eye.frustum_center, eye.frustum_width = 0.0, near * lens.tan_x
      eye.frustum_top, eye.frustum_bottom = near * lens.tan_y, -near * lens.tan_y
      eye.frustum_near, eye.frustum_far, eye.orthographic = near, far, 0
    view = mujoco.MjrRect(0, 0, lens.width, lens.height)
    color = np.empty((lens.height, lens.width, 3), np.uint8)
    raw = np.empty((lens.height, lens.width), np.float32)
    self._gl.make_current()
    mujoco.mjr_render(view, self._scene, self._context)
    mujoco.mjr_readPixels(color, raw, view, self._context)
    depth = near * far / (raw * (far - near) + near)
    return color[::-1], depth[::-1]

  @property
  def _planes(self) -> tuple[float, float]:
    return self._model.vis.map.znear, self._model.vis.map.zfar

  def close(self) -> None:
    """Frees the OpenGL context."""
    if self._gl is not None:
      self._context.free()
      self._gl.free()
      self._gl = None

  def __enter__(self) -> "Eye":
    return self

  def __exit__(self, *_) -> None:
    self.close()
