"""Where a model's camera looks along the measured motion.

Shapes: G samples of joint states, T times.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model import chains
from nerf2real.sysid.model.motion import smooth_motion

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class View:
  """A camera's pose over time."""

  time: Array
  """[G] s."""
  turn: Rotation
  """G rotations, world from camera with OpenCV's axes."""
  place: Array
  """[G, 3] m."""

  def rotation(self, time: Array) -> Rotation:
    """Returns the camera's orientation at times [T], the nearest one outside the log."""
    return Slerp(self.time, self.turn)(np.clip(time, self.time[0], self.time[-1]))

  def position(self, time: Array) -> Array:
    """Returns the camera's place [T, 3] at times [T]."""
    return np.stack([np.interp(time, self.time, c) for c in self.place.T], axis=1)

  def reach(self) -> float:
    """Returns the largest angle from the first orientation, rad."""
    return float((self.turn[0].inv() * self.turn).magnitude().max())


def choose(model: mujoco.MjModel, frame: str) -> int | None:
  """Returns the camera that bears the frame's name, else the model's only one, else None."""
  names = [model.camera(i).name for i in range(model.ncam)]
  if frame in names:
    return names.index(frame)
  return 0 if len(names) == 1 else None


def unmeasured(model: mujoco.MjModel, camera: int, joints: Sequence[str]) -> list[str]:
  """Returns the joints between the world and a camera that are not among the measured ones."""
  missing, body = [], int(model.cam_bodyid[camera])
  while body:
    first = int(model.body_jntadr[body])
    for index in range(first, first + int(model.body_jntnum[body])):
      name = model.joint(index).name
      if int(model.jnt_type[index]) not in chains.SINGLE or name not in joints:
        missing.append(name or f"the free joint of {model.body(body).name!r}")
    body = int(model.body_parentid[body])
  return missing


def along(model: mujoco.MjModel, log: Log, camera: int) -> View:
  """Returns a camera's pose along a log: the joints are where they were measured."""
  motion, data = smooth_motion(log), mujoco.MjData(model)
  qpos = model.jnt_qposadr[[model.joint(name).id for name in log.joints]]
  count = len(motion.time)
  turn, place = np.empty((count, 3, 3)), np.empty((count, 3))
  for n in range(count):
    data.qpos[qpos] = motion.position[n]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    turn[n] = data.cam_xmat[camera].reshape(3, 3) @ OPENGL_FROM_OPENCV
    place[n] = data.cam_xpos[camera]
  return View(motion.time, Rotation.from_matrix(turn), place)
