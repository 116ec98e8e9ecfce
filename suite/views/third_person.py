"""A spectator's view of the robot in its room: the radiance field with the moving geoms in it.

No GL is needed: field and geoms come from the same renderers as the robot's own picture. The view
stays where nothing of the room stands between it and the robot, about where the capture looked from
where that is known, and turns around it where the room would bring it too near. Shapes: H height,
W width.
"""

from typing import Any

import cv2
import mujoco
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import camera_axes
from nerf2real.suite.op3 import op3
from nerf2real.suite.sensors.camera import GeomCaster, RobotCamera
from nerf2real.suite.tasks.base import RobotTask

_DISTANCE = 1.4  # m from the robot
_ELEVATIONS = np.deg2rad([22.0, 35.0, 50.0])  # that are tried; the first is the preferred one
_FIELD_OF_VIEW = np.deg2rad(42.0)  # vertical
_PREFERRED = np.deg2rad(130.0)  # rad from the robot's heading: beside and a little behind it
_DIRECTIONS = 24  # azimuths that are tried
_FLOOR_BONUS, _TURN_COST = 0.7, 0.05  # worth of free floor below the view [m], of turning [m/rad]
_UNSEEN_COST = 1.0  # of a view that the capture lacks, for each metre and radian that it is off
_CLEARANCE = 0.15  # m kept from what stands behind the view
_FOLLOW = 0.06  # share of the way by which the view follows the robot in a frame
_NEAR = 1.0  # m: from nearer the robot, 0.5 m tall, fills two thirds of the picture's height
_BESIDE = 0.2  # share of its distance by which the view may look past the robot; 0.38 is the edge
_FIELD_SHARE = 3  # the field is rendered at this fraction of the size: it takes most of the time
_DEPTH_SLACK = 0.03  # m by which the field's depth may err before it hides a geom
_FLOOR_HEIGHT = 0.04  # m: what is lower than this takes a shadow
_SHADOW_DEPTH, _SHADOW_RADIUS = 0.5, 0.09  # darkening under a body, and its standard deviation [m]


def direction(angles: np.ndarray) -> np.ndarray:
  """Returns the unit vector [3] from the robot to a view at azimuth and elevation [2] [rad]."""
  azimuth, elevation = angles
  level = np.cos(elevation)
  return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def clear_distance(physics: Any, start: np.ndarray, way: np.ndarray) -> float:
  """Returns how far [m] a view may be from `start` along the unit vector `way`."""
  groups = np.zeros(mujoco.mjNGROUP, np.uint8)
  groups[op3.SCENE_GROUP] = 1
  hit = mujoco.mj_ray(
    physics.model.ptr, physics.data.ptr, start, way, groups, 1, -1, np.zeros(1, np.int32)
  )
  free = _DISTANCE if hit < 0 else hit - _CLEARANCE
  return float(np.clip(free, 0.3, _DISTANCE))


def best_angles(task: RobotTask, physics: Any, *, preferred: float | None = None) -> np.ndarray:
  """Returns azimuth and elevation [2] [rad] from the robot of a view that sees it best.

  It is clear of the room's parts, near a view that the capture has, where the scene knows these,
  and, if there is such a one, above floor where the robot could walk. Of several, the one nearest
  to the preferred azimuth and to level.

  Args:
    task: The task.
    physics: Its compiled model and state.
    preferred: The preferred azimuth [rad]; beside the robot and a little behind it if None.
  """
  position = task.state.position
  preferred = task.state.yaw + _PREFERRED if preferred is None else preferred
  turns = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
  turns = np.where(turns > np.pi, turns - 2 * np.pi, turns)  # from the preferred azimuth
  views = getattr(task.scene, "views", None)
  elevations = _ELEVATIONS[:1] if views is None else _ELEVATIONS
  turn, elevation = (grid.ravel() for grid in np.meshgrid(turns, elevations))
  angles = np.stack([preferred + turn, elevation], axis=1)
  ways = np.array([direction(each) for each in angles])
  free = np.array([clear_distance(physics, position, way) for way in ways])
  places = position + free[:, None] * ways
  above_floor = np.asarray(task.scene.free_space.is_reachable(places[:, :2]), np.float64)
  score = free + _FLOOR_BONUS * above_floor
  score -= _TURN_COST * (np.abs(turn) + elevation - elevations[0])
  if views is not None:
    away = np.linalg.norm(places[:, None] - views[0], axis=-1)
    turned = np.arccos(np.clip(-ways @ views[1].T, -1.0, 1.0))
    score -= _UNSEEN_COST * (away + turned).min(axis=1)
  best: np.ndarray = angles[np.argmax(score)]
  return best


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
  """Returns the pose world from camera [4, 4] (OpenCV's axes), upright, looking at a point."""
  forward = (target - position) / np.linalg.norm(target - position)
  pose = np.eye(4)
  pose[:3, :3] = camera_axes(forward)
  pose[:3, 3] = position
  return pose


class ThirdPerson:
  """A view that follows the robot."""

  def __init__(self, task: RobotTask, physics: Any, *, height: int, width: int):
    """Prepares the rays.

    Args:
      task: The task; its robot needs a camera, whose renderer of the scene is used.
      physics: Its compiled model.
      height: Height of the picture [pixel].
      width: Width of the picture [pixel].

    Raises:
      ValueError: The environment was loaded without pictures.
    """
    if task.robot_camera is None:
      raise ValueError(
        "The third-person view needs a renderer of the scene, found an environment without "
        "pictures: load it with an image_size."
      )
    self._task, self._physics = task, physics
    self._camera: RobotCamera = task.robot_camera
    lens = Camera.from_vertical_fov(_FIELD_OF_VIEW, width, height)
    self._lens = lens.resized(width // _FIELD_SHARE, height // _FIELD_SHARE)
    self._rays = self._lens.rays().reshape(-1, 3)
    self._caster = GeomCaster(physics.model.ptr, lens, groups=(op3.VISIBLE_GROUP, op3.HEAD_GROUP))
    self._size = (width, height)
    self.restart()

  def restart(self) -> None:
    """Chooses the view anew, as at the start of an episode."""
    self._target = self._task.state.position.copy()
    self._angles = self._wanted = best_angles(self._task, self._physics)
    self._distance = clear_distance(self._physics, self._target, direction(self._angles))

  def draw(self) -> np.ndarray:
    """Returns the picture now, RGB uint8 [H, W, 3]."""
    pose = self._follow()
    color, depth = self._camera.render_field(pose, self._lens)
    color = self._shadow(color, depth, pose)
    picture = cv2.resize(color, self._size, interpolation=cv2.INTER_LINEAR)
    depth = cv2.resize(depth, self._size, interpolation=cv2.INTER_NEAREST).ravel()
    pixels, distances, ids, normals = self._caster.cast(self._physics.data.ptr, pose)
    front = np.flatnonzero(distances < depth[pixels] + _DEPTH_SLACK)
    shade = self._caster.shade(ids[front], normals[front])
    picture.reshape(-1, 3)[pixels[front]] = shade
    return picture

  def _follow(self) -> np.ndarray:
    """Moves the view a frame on; returns its pose, world from camera [4, 4].

    It draws near at once where something is in the way, and back little by little.
    """
    position = self._task.state.position
    if clear_distance(self._physics, position, direction(self._wanted)) < _NEAR:
      self._wanted = best_angles(self._task, self._physics, preferred=self._wanted[0])
    self._angles = self._angles + _FOLLOW * (self._wanted - self._angles)
    way = direction(self._angles)
    self._target += _FOLLOW * (position - self._target)
    free = clear_distance(self._physics, self._target, way)
    self._distance = min(free, self._distance + _FOLLOW * (free - self._distance))
    behind = position - self._target
    most = _BESIDE * self._distance
    self._target = position - behind * min(1.0, most / max(float(np.linalg.norm(behind)), most))
    return look_at(self._target + self._distance * way, self._target)

  def _shadow(self, color: np.ndarray, depth: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Darkens the floor under the robot and the ball."""
    points = (self._rays * np.where(np.isfinite(depth), depth, 1e3).reshape(-1, 1)) @ pose[:3, :3].T
    points += pose[:3, 3]
    bodies = [self._task.state.position]
    ball = getattr(self._task, "ball_position", None)
    if ball is not None:
      bodies.append(ball)
    light = np.ones(len(points))
    for body in bodies:
      squared = np.sum((points[:, :2] - body[:2]) ** 2, axis=1)
      light -= _SHADOW_DEPTH * np.exp(-squared / (2 * _SHADOW_RADIUS**2))
    light = np.where(points[:, 2] < _FLOOR_HEIGHT, np.maximum(light, 0.3), 1.0)
    return (color * light.reshape(*color.shape[:2], 1)).astype(np.uint8)
