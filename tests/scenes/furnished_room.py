"""An analytic room of boxes: exact depth by MuJoCo's ray casting, for the tests of geometry."""

import mujoco
import numpy as np

from nerf2real.core.geometry import cameras
from nerf2real.scenes.geometry import fusion

# Centre and half size of each box [m]: a room of 5 x 4 x 2.5 m, floor at z = 0.
WALLS = {
  "floor": ((0, 0, -0.05), (2.6, 2.1, 0.05)),
  "ceiling": ((0, 0, 2.55), (2.6, 2.1, 0.05)),
  "west": ((-2.55, 0, 1.25), (0.05, 2.1, 1.3)),
  "east": ((2.55, 0, 1.25), (0.05, 2.1, 1.3)),
  "south": ((0, -2.05, 1.25), (2.6, 0.05, 1.3)),
  "north": ((0, 2.05, 1.25), (2.6, 0.05, 1.3)),
}
FURNITURE = {
  "table": ((1.2, 1.0, 0.72), (0.7, 0.5, 0.03)),
  "leg0": ((0.56, 0.56, 0.345), (0.03, 0.03, 0.345)),
  "leg1": ((1.84, 0.56, 0.345), (0.03, 0.03, 0.345)),
  "leg2": ((0.56, 1.44, 0.345), (0.03, 0.03, 0.345)),
  "leg3": ((1.84, 1.44, 0.345), (0.03, 0.03, 0.345)),
  "shelf": ((-2.3, 0.6, 0.9), (0.2, 0.6, 0.9)),
  "box": ((-0.9, -1.2, 0.2), (0.3, 0.2, 0.2)),
}


def model() -> mujoco.MjModel:
  """Compiles the room."""
  geoms = "".join(
    f'<geom name="{name}" type="box" pos="{" ".join(map(str, p))}" size="{" ".join(map(str, s))}"/>'
    for name, (p, s) in (WALLS | FURNITURE).items()
  )
  return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")


def distance(points: np.ndarray, boxes=None) -> np.ndarray:
  """Unsigned distance [P] of points [P, 3] to the nearest surface of the boxes."""
  best = np.full(len(points), np.inf)
  for position, size in (boxes or WALLS | FURNITURE).values():
    q = np.abs(points - position) - size
    outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
    best = np.minimum(best, np.abs(outside + np.minimum(q.max(-1), 0)))
  return best


def look_at(position, target) -> np.ndarray:
  """Pose [4, 4] of a level camera at a position [3] that looks at a target [3]."""
  forward = np.subtract(target, position)
  forward = forward / np.linalg.norm(forward)
  right = np.cross(forward, [0, 0, 1.0])
  right /= np.linalg.norm(right)
  pose = np.eye(4)
  pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
  pose[:3, 3] = position
  return pose


def walk(count: int) -> np.ndarray:
  """Camera poses [count, 4, 4] of a loop through the room at about 1.4 m, looking about."""
  poses = []
  for i in range(count):
    a = 2 * np.pi * i / count
    position = [1.3 * np.cos(a) - 0.1, 0.9 * np.sin(a) - 0.2, 1.4 + 0.15 * np.sin(3 * a)]
    b = a + (0.4 if i % 2 else np.pi - 0.5)
    poses.append(look_at(position, [3 * np.cos(b), 3 * np.sin(b), (0.1, 0.7, 0.2, 1.4)[i % 4]]))
  return np.array(poses)


def depth_views(poses: np.ndarray, camera: cameras.Camera, *, noise=0.0, rng=None):
  """Casts every pixel's ray against the room; noise is relative to the depth."""
  m = model()
  d = mujoco.MjData(m)
  mujoco.mj_forward(m, d)
  rays = camera.rays().reshape(-1, 3)
  depth = np.empty((len(poses), len(rays)), np.float32)
  for n, pose in enumerate(poses):
    hit, found = np.empty(len(rays), np.int32), np.empty(len(rays))
    mujoco.mj_multiRay(
      m,
      d,
      pose[:3, 3],
      (rays @ pose[:3, :3].T).ravel(),
      None,
      True,
      -1,
      hit,
      found,
      None,
      len(rays),
      1e6,
    )
    depth[n] = np.where(hit >= 0, found, np.inf)  # rays have z = 1: the parameter is the z-depth
  if noise:
    depth *= 1 + noise * rng.standard_normal(depth.shape)
  return fusion.DepthViews(
    camera=camera,
    frame_from_camera=poses,
    depth=depth.reshape(len(poses), camera.height, camera.width),
  )
