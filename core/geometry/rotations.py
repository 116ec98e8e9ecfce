"""Rotations between named frames, beside scipy.spatial.transform.Rotation.

`a_from_b` maps coordinates in frame b to frame a. The world has z up. Camera axes follow OpenCV:
x right, y down, z forward. Quaternions are (w, x, y, z), as MuJoCo has them: give scipy's functions
`scalar_first=True`.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

# OpenCV's camera axes in those of OpenGL and MuJoCo (x right, y up, z backward): a half turn about
# x, its own inverse. world_from_opencv = world_from_opengl @ OPENGL_FROM_OPENCV.
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])

_RIGID = 1e-2  # of R R^T to the identity: written with few digits a rotation is one still
_OPPOSITE = 1e-8  # sine of the angle below which two vectors are taken for opposite

# How a hand holds a camera; chosen, and two rooms' floors change by half a degree with half of it.
ROLL, PITCH = np.radians([5.0, 30.0])  # standard deviations from level
_MOST_ROLLED = 0.5  # sine of the roll of a camera that is held so


def is_rigid(pose: np.ndarray) -> bool:
  """Whether the 3x3 part of a pose [>= 3, >= 3] is a rotation, as far as its digits say."""
  rotation = pose[:3, :3]
  deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
  return bool(deviation < _RIGID and np.linalg.det(rotation) > 0)


def shortest_rotation(
  start: np.ndarray, end: np.ndarray, *, half_turn_axis: np.ndarray | None = None
) -> np.ndarray:
  """Returns the rotation [3, 3] by the smallest angle that takes one unit vector [3] to another.

  R = I + K + K^2 / (1 + cos), K the cross product matrix of start x end (Rodrigues' formula); for
  obtuse angles with (1 - cos) / sin^2 in place of 1 / (1 + cos), which cancels near a half turn. It
  runs at every control step, so without scipy's align_vectors, which is some ten times slower.

  Args:
    start: The vector to turn.
    end: Where to.
    half_turn_axis: Unit vector across `start` [3], the axis where both are opposite, for which the
      smallest rotation is not unique; if None, as near to x as possible, or else to y.
  """
  cosine = float(start @ end)
  x, y, z = np.cross(start, end)
  square = float(x * x + y * y + z * z)
  if cosine < 0 and square < _OPPOSITE**2:
    if half_turn_axis is None:
      near = np.eye(3)[0 if abs(start[0]) < 0.9 else 1]
      half_turn_axis = near - (near @ start) * start
      half_turn_axis /= np.linalg.norm(half_turn_axis)
    return 2 * np.outer(half_turn_axis, half_turn_axis) - np.eye(3)
  cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
  scale = 1 / (1 + cosine) if cosine > 0 else (1 - cosine) / square
  return np.eye(3) + cross + cross @ cross * scale


def rotation_to_up(up: np.ndarray) -> np.ndarray:
  """Returns the smallest rotation [3, 3] that turns a unit vector [3] to +z."""
  return shortest_rotation(np.asarray(up, np.float64), np.array([0.0, 0.0, 1.0]))


def yaw_matrix(yaw: float) -> np.ndarray:
  """Returns the rotation [3, 3] about z by an angle [rad]."""
  return Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()


def yaw_quaternion(yaw: float) -> np.ndarray:
  """Returns the quaternion (w, x, y, z) of a rotation about z by an angle [rad]."""
  return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def yaw_of(world_from_body: np.ndarray) -> float:
  """Returns the heading of a body's x axis in the world [rad], from a rotation matrix [3, 3]."""
  return float(np.arctan2(world_from_body[1, 0], world_from_body[0, 0]))


def matrix_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
  """Returns the rotation matrix [3, 3] of a quaternion (w, x, y, z) of any length."""
  return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def quaternion_from_matrix(matrix: np.ndarray) -> np.ndarray:
  """Returns the unit quaternion (w, x, y, z) of a rotation matrix [3, 3]."""
  return Rotation.from_matrix(matrix).as_quat(scalar_first=True)


def quaternion_from_rotvec(vector: ArrayLike) -> np.ndarray:
  """Returns the unit quaternion (w, x, y, z) of a rotation vector [3] [rad]."""
  return Rotation.from_rotvec(vector).as_quat(scalar_first=True)


def matrix_from_rotvec(vector: ArrayLike) -> np.ndarray:
  """Returns the rotation matrix [3, 3] of a rotation vector [3] [rad]."""
  return Rotation.from_rotvec(vector).as_matrix()


def rotate_quaternion(vector: ArrayLike, quaternion: np.ndarray) -> np.ndarray:
  """Returns a quaternion (w, x, y, z) turned by a rotation vector [3] [rad] of the outer frame."""
  turned = Rotation.from_rotvec(vector) * Rotation.from_quat(quaternion, scalar_first=True)
  return turned.as_quat(scalar_first=True)


def camera_axes(forward: np.ndarray) -> np.ndarray:
  """Returns world_from_camera rotations [..., 3, 3] of upright cameras (OpenCV's axes).

  Args:
    forward: Unit viewing directions in the world [..., 3], none of them vertical.
  """
  right = np.cross(forward, [0.0, 0.0, 1.0])
  right /= np.linalg.norm(right, axis=-1, keepdims=True)
  return np.stack([right, np.cross(forward, right), forward], axis=-1)


def level_up(world_from_camera: np.ndarray, rough: np.ndarray) -> np.ndarray:
  """Up direction [3] of cameras [N, 4, 4] that are held level but may all look down.

  It is as perpendicular as can be to the cameras' right axes, which a hand keeps level, and, for
  what these leave open, to the directions in which they look: the least eigenvector of
  sum r r^T / roll^2 + f f^T / pitch^2. The mean of the cameras' own up directions leans to where
  they look from above.

  Args:
    world_from_camera: Poses, OpenCV axes.
    rough: Mean up direction; cameras that are rolled against it take no part, and of two opposite
      results the nearer one is taken.
  """
  right, forward = world_from_camera[:, :3, 0], world_from_camera[:, :3, 2]
  held = np.abs(right @ rough) < _MOST_ROLLED * np.linalg.norm(rough)
  if not held.any():
    return rough / np.linalg.norm(rough)
  right, forward = right[held] / ROLL, forward[held] / PITCH
  up: np.ndarray = np.linalg.eigh(right.T @ right + forward.T @ forward)[1][:, 0]
  return up if up @ rough > 0 else -up


def pose_of_mujoco_camera(position: np.ndarray, world_from_mujoco: np.ndarray) -> np.ndarray:
  """Returns world_from_camera [4, 4], OpenCV's axes, of `cam_xpos` [3] and `cam_xmat` [9]."""
  pose = np.eye(4)
  pose[:3, :3] = np.reshape(world_from_mujoco, (3, 3)) @ OPENGL_FROM_OPENCV
  pose[:3, 3] = position
  return pose
