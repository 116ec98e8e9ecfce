"""The robot's camera: the scene's radiance field and MuJoCo's moving geoms in one picture.

Both are cast along the same rays, one for each pixel, from the calibrated OPENCV model (distortion
included): the field by `scenes.field.render.renderer.Renderer`, the geoms by
MuJoCo's own ray caster, so that no GL is needed. Per pixel the nearer one is seen. The paper
draws the moving objects always in front (`compositing="overlay"`). Shapes: H height, W width, N
rays, G geoms.
"""

import dataclasses
from typing import Any, Protocol

import mujoco
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import pose_of_mujoco_camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.sensors.light import FIXED, Light

DEPTH, OVERLAY = "depth", "overlay"
_DISPLAY_GAMMA = 2.2  # of the pictures: light = value ** 2.2
_CULLING_SLACK = 1e-3  # rad added to the cone around a geom
_TILE = 16  # pixels, side of the tiles that are culled before single rays are


class FieldRenderer(Protocol):
  """What the camera needs of a renderer of the scene."""

  def render(self, camera: Camera, unit_from_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns colour uint8 [H, W, 3] and z-depth float32 [H, W], inf where there is nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraSettings:
  """Settings of the robot's camera; the defaults are neutral."""

  lens: Camera | None = None
  """a calibrated camera; None: no distortion, 43.3 degrees vertically."""
  compositing: str = DEPTH
  """"depth", or "overlay": moving objects always in front, as the paper."""
  gain: float = 1.0
  """Factor on the light; the paper's gains are ratios of its default of 50."""
  exposure: float = 1.0
  """Another factor on the light."""
  white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
  """Factors on red, green, blue light."""
  noise: float = 0.0
  """Standard deviation of the noise at gain 1 [8-bit levels]."""
  latency: float = 0.0
  """s, in addition to the delay that an episode draws."""
  rate: float = 1 / constants.CONTROL_TIMESTEP
  """Pictures a second [Hz]; between two the last stays."""

  def __post_init__(self):
    if self.compositing not in (DEPTH, OVERLAY):
      raise ValueError(
        f"Unknown compositing {self.compositing!r}: expected {DEPTH!r} or {OVERLAY!r}."
      )
    for name in ("gain", "exposure"):
      if not 0 < getattr(self, name) < np.inf:
        raise ValueError(f"The camera's {name} must be positive, found {getattr(self, name)}.")
    if np.shape(self.white_balance) != (3,) or not (np.asarray(self.white_balance) > 0).all():
      raise ValueError(
        "The camera's white_balance must be three positive factors on red, green and blue, found "
        f"{self.white_balance}."
      )
    for name in ("noise", "latency"):
      if not 0 <= getattr(self, name) < np.inf:
        raise ValueError(f"The camera's {name} must be 0 or more, found {getattr(self, name)}.")
    fastest = 1 / constants.CONTROL_TIMESTEP
    if not 0 < self.rate <= fastest:
      raise ValueError(
        f"The camera's rate must be above 0 and at most that of the control, {fastest:g} Hz, found "
        f"{self.rate:g} Hz."
      )

  def camera(self, image_size: tuple[int, int]) -> Camera:
    """Returns the camera model for a picture of (height, width)."""
    height, width = _checked_size(image_size)
    if self.lens is not None:
      return self.lens.resized(width, height)
    return Camera.from_vertical_fov(constants.CAMERA_VERTICAL_FOV, width, height)

  def response(self) -> np.ndarray | None:
    """Returns the table uint8 [256, 3] from neutral to recorded values; None if it is neutral.

    value' = 255 * clip(gain * exposure * balance * (value / 255)^2.2)^(1 / 2.2)
    """
    factors = self.gain * self.exposure * np.asarray(self.white_balance, np.float64)
    if (factors == 1).all():
      return None
    levels = np.arange(256)[:, None] * factors ** (1 / _DISPLAY_GAMMA)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _checked_size(image_size: tuple[int, int]) -> tuple[int, int]:
  try:
    height, width = (int(number) for number in image_size)
  except (TypeError, ValueError):
    height = width = 0
  if height < 1 or width < 1:
    raise ValueError(
      f"image_size must be (height, width) of at least 1 pixel each, found {image_size!r}; "
      "the paper uses (30, 40) and (60, 80)."
    )
  return height, width


def world_from_camera(data: mujoco.MjData, camera_id: int) -> np.ndarray:
  """Returns the pose [4, 4] of a MuJoCo camera with OpenCV's axes."""
  return pose_of_mujoco_camera(data.cam_xpos[camera_id], data.cam_xmat[camera_id])


def _tiles(
  directions: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns tiles of a picture's rays, to cull geoms by.

  Args:
    directions: Unit vectors of the rays [H * W, 3].
    shape: Height and width of the picture.

  Returns:
    The tile of each ray [H * W], and of each tile the axis [T, 3] and the half angle [rad] of the
    cone that holds its rays [T].
  """
  rows, columns = (np.arange(size) // _TILE for size in shape)
  tiles = (rows[:, None] * (columns[-1] + 1) + columns).ravel()
  sums = np.stack([np.bincount(tiles, weights=directions[:, k]) for k in range(3)], axis=1)
  axes = sums / np.linalg.norm(sums, axis=1, keepdims=True)
  away = np.arccos(np.clip(np.einsum("ni,ni->n", directions, axes[tiles]), -1.0, 1.0))
  angles = np.zeros(len(axes))
  np.maximum.at(angles, tiles, away)
  return tiles, axes, angles


class GeomCaster:
  """Casts a camera's rays against the geoms that can move."""

  def __init__(
    self, model: mujoco.MjModel, camera: Camera, *, groups: tuple[int, ...] = (op3.VISIBLE_GROUP,)
  ):
    """Prepares the rays.

    Args:
      model: The compiled model; its `geom_rgba` and sizes are read at every call.
      camera: The camera model.
      groups: The MuJoCo geom groups that are seen.
    """
    self._model = model
    self._shape = (camera.height, camera.width)
    self._rays = camera.rays().reshape(-1, 3)  # [N, 3], z = 1
    self._directions = self._rays / np.linalg.norm(self._rays, axis=1, keepdims=True)
    self._tiles, self._tile_axes, self._tile_angles = _tiles(self._directions, self._shape)
    moving = model.body_weldid[model.geom_bodyid] != 0
    self._geoms = np.flatnonzero(np.isin(model.geom_group, groups) & moving)
    self._groups = np.zeros(mujoco.mjNGROUP, np.uint8)
    self._groups[list(groups)] = 1
    self.light = FIXED
    count = len(self._rays)
    self._ids, self._depth = np.empty(count, np.int32), np.empty(count)
    self._normals = np.empty(3 * count)

  def candidates(self, data: mujoco.MjData, pose: np.ndarray) -> np.ndarray:
    """Returns the indices of rays that come near a geom's bounding sphere."""
    offsets = (data.geom_xpos[self._geoms] - pose[:3, 3]) @ pose[:3, :3]  # camera frame [G, 3]
    distances = np.sqrt(np.einsum("gi,gi->g", offsets, offsets))
    radii = self._model.geom_rbound[self._geoms]
    ahead = offsets[:, 2] > -radii  # nothing behind the camera is seen
    offsets, distances, radii = offsets[ahead], distances[ahead], radii[ahead]
    if not len(offsets):
      return np.empty(0, np.int64)
    outside = distances > radii
    angle = np.arcsin(np.divide(radii, distances, where=outside, out=np.ones_like(radii)))
    limits = np.where(outside, angle + _CULLING_SLACK, np.pi)
    axes = offsets / np.maximum(distances, 1e-9)[:, None]  # [G, 3]
    wider = np.minimum(limits[:, None] + self._tile_angles, np.pi)  # [G, T]
    near = (axes @ self._tile_axes.T >= np.cos(wider)).any(axis=0)
    rays = np.flatnonzero(near[self._tiles])
    cosines = axes @ self._directions[rays].T  # [G, R]
    return rays[(cosines >= np.cos(limits)[:, None]).any(axis=0)]

  def cast(self, data: mujoco.MjData, pose: np.ndarray) -> tuple[np.ndarray, ...]:
    """Casts the rays.

    Args:
      data: MuJoCo's state with kinematics up to date.
      pose: World from camera [4, 4], OpenCV's axes.

    Returns:
      The hit rays' pixel indices [K], z-depths [K] [m], geom ids [K] and unit normals [K, 3].
    """
    rays = self.candidates(data, pose)
    count = len(rays)
    ids, depth, normals = self._ids[:count], self._depth[:count], self._normals[: 3 * count]
    if count:
      vectors = (self._rays[rays] @ pose[:3, :3].T).ravel()
      mujoco.mj_multiRay(
        self._model,
        data,
        pose[:3, 3].copy(),
        vectors,
        self._groups,
        0,
        -1,
        ids,
        depth,
        normals,
        count,
        mujoco.mjMAXVAL,
      )
    hit = np.flatnonzero(ids >= 0) if count else rays
    return rays[hit], depth[hit], ids[hit], normals.reshape(-1, 3)[hit]

  def shade(self, ids: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the colours uint8 [K, 3] of surfaces: the geom's colour in the present light."""
    colors = self._model.geom_rgba[ids, :3] * self.light.on(normals)
    return np.clip(np.rint(255 * colors), 0, 255).astype(np.uint8)


class RobotCamera:
  """The picture that the robot takes."""

  def __init__(
    self,
    renderer: FieldRenderer,
    camera: Camera,
    *,
    world_from_unit: Similarity,
    settings: CameraSettings | None = None,
  ):
    """Connects a renderer of the scene with the lens of the robot.

    Args:
      renderer: Renders the field in the unit frame.
      camera: The robot's lens at the picture's size.
      world_from_unit: Maps the field's frame to the world [m].
      settings: How the sensor responds and how geoms are composited.
    """
    self.camera = self._declared = camera
    self.settings = settings or CameraSettings()
    self._declared_gain = self.settings.gain
    self._renderer = renderer
    self._unit_from_world = world_from_unit.inverse()
    self._meters_per_unit = world_from_unit.scale
    self._response = self.settings.response()
    self._model: mujoco.MjModel | None = None
    self.caster: GeomCaster | None = None
    self.camera_id = -1

  @property
  def shape(self) -> tuple[int, int, int]:
    """The picture's shape (H, W, 3)."""
    return self.camera.height, self.camera.width, 3

  def set_gain(self, ratio: float) -> None:
    """Makes the gain a multiple of the declared one, from the next picture on."""
    self.settings = dataclasses.replace(self.settings, gain=ratio * self._declared_gain)
    self._response = self.settings.response()

  def set_light(self, light: Light) -> None:
    """Changes the light on what moves, from the next picture on."""
    if self.caster is None:
      raise RuntimeError("The camera has no model yet: call bind(model, camera_id) first.")
    self.caster.light = light

  def set_focal_scale(self, scale: float) -> None:
    """Makes the focal length a multiple of the declared one, from the next picture on."""
    fx, fy = scale * self._declared.fx, scale * self._declared.fy
    if (fx, fy) == (self.camera.fx, self.camera.fy):
      return
    self.camera = dataclasses.replace(self._declared, fx=fx, fy=fy)
    if self._model is not None:
      self.bind(self._model, self.camera_id)

  def bind(self, model: mujoco.MjModel, camera_id: int) -> None:
    """Takes the geoms and the mounting from a compiled model."""
    self._model = model
    self.caster = GeomCaster(model, self.camera)
    self.camera_id = camera_id

  def render_field(
    self, pose: np.ndarray, lens: Camera | None = None
  ) -> tuple[np.ndarray, np.ndarray]:
    """Renders the scene alone: colour uint8 [H, W, 3] and z-depth [H, W] [m].

    Args:
      pose: World from camera [4, 4], OpenCV's axes.
      lens: Another camera model than the robot's, for a spectator's view.
    """
    unit_from_camera = self._unit_from_world.apply_pose(pose)
    color, depth = self._renderer.render(lens or self.camera, unit_from_camera)
    return color, depth * self._meters_per_unit

  def render(self, data: mujoco.MjData, random_state: np.random.RandomState | None = None) -> Any:
    """Returns the picture uint8 [H, W, 3] at a state with kinematics up to date.

    Args:
      data: MuJoCo's state.
      random_state: Source of the sensor's noise; without one there is none.
    """
    if self.caster is None:
      raise RuntimeError("The camera has no model yet: call bind(model, camera_id) first.")
    pose = world_from_camera(data, self.camera_id)
    color, depth = self.render_field(pose)
    pixels, distances, ids, normals = self.caster.cast(data, pose)
    if len(pixels):
      if self.settings.compositing == DEPTH:
        front = np.flatnonzero(distances < depth.reshape(-1)[pixels])
        pixels, ids, normals = pixels[front], ids[front], normals[front]
      color = np.array(color)
      color.reshape(-1, 3)[pixels] = self.caster.shade(ids, normals)
    return self._develop(color, random_state)

  def _develop(self, color: np.ndarray, random_state: np.random.RandomState | None) -> np.ndarray:
    """Applies the sensor's response and noise."""
    if self._response is not None:
      color = np.stack([self._response[color[..., i], i] for i in range(3)], axis=-1)
    if self.settings.noise > 0 and random_state is not None:
      deviation = self.settings.noise * self.settings.gain
      noisy = color + random_state.normal(0.0, deviation, color.shape)
      color = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return color
