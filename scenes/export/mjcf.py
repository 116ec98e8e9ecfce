"""Writes a scene as MJCF that stands alone: scene.xml with meshes and texture beside it.

MuJoCo has no lens distortion: the camera is the pinhole with the calibrated focal lengths and
principal point, and the coefficients are left to a comment.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from nerf2real.core import files
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV, yaw_matrix, yaw_quaternion
from nerf2real.core.picture_files import write_picture
from nerf2real.scenes.export.texture import TexturedMesh
from nerf2real.scenes.geometry import collision, convex

COLLISION_GROUP = (
  3  # hidden by MuJoCo's viewer until it is switched on, as menagerie models have it
)
VISUAL_GROUP = 2
_SENSOR_WIDTH = 0.0048  # of the camera [m]: 1/3 inch; chosen: pictures depend on ratios alone
_FLOOR_MARGIN = 1.0  # of the plane around the scene's extent [m]


def floor_of(extent: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
  """Returns middle and half size [2] each [m] of the floor below a scene with a margin around it.

  Args:
    extent: Lower and upper corner of the scene [3] each [m].
  """
  lower, upper = extent
  return (lower + upper)[:2] / 2, (upper - lower)[:2] / 2 + _FLOOR_MARGIN


def scene_spec(
  parts: Sequence[convex.Part], *, extent: tuple[np.ndarray, np.ndarray], name: str
) -> mujoco.MjSpec:
  """Returns the parts, the floor plane and light as a specification without files.

  Args:
    parts: Convex parts, world frame.
    extent: Lower and upper corner of the scene [3] each [m].
    name: Of the model.
  """
  spec = collision.spec(parts, floor=False)
  spec.modelname = name
  spec.compiler.degree = False
  center, half = floor_of(extent)
  spec.stat.center = [*center, 0.5]
  spec.stat.extent = float((extent[1] - extent[0])[:2].max() / 2)
  spec.visual.headlight.ambient = [0.9, 0.9, 0.9]  # the texture has the room's light already
  spec.visual.headlight.diffuse = [0.1, 0.1, 0.1]
  spec.visual.headlight.specular = [0, 0, 0]
  spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
  spec.worldbody.add_geom(
    name="floor",
    type=mujoco.mjtGeom.mjGEOM_PLANE,
    pos=[*center, 0],
    size=[*half, 0.05],
    group=COLLISION_GROUP,
  )
  for geom in spec.geoms:
    geom.group = COLLISION_GROUP
  return spec


def mujoco_quaternion(world_from_camera: np.ndarray) -> np.ndarray:
  """Orientation (w, x, y, z) of a MuJoCo camera at a pose [4, 4] with OpenCV axes."""
  quaternion = np.empty(4)
  mujoco.mju_mat2Quat(quaternion, (world_from_camera[:3, :3] @ OPENGL_FROM_OPENCV).ravel())
  return quaternion


def add_camera(
  spec: mujoco.MjSpec, camera: Camera, world_from_camera: np.ndarray, *, name: str
) -> None:
  """Adds a camera with calibrated intrinsics at a pose [4, 4] with OpenCV axes."""
  shown = spec.visual.global_
  shown.offwidth = max(shown.offwidth, camera.width)
  shown.offheight = max(shown.offheight, camera.height)
  size = _SENSOR_WIDTH * np.array([1.0, camera.height / camera.width])
  spec.worldbody.add_camera(
    name=name,
    pos=world_from_camera[:3, 3],
    quat=mujoco_quaternion(world_from_camera),
    resolution=[camera.width, camera.height],
    sensor_size=size,
    focal_pixel=[camera.fx, camera.fy],
    # from the image point of the axis to the picture's centre
    principal_pixel=[camera.width / 2 - camera.cx, camera.height / 2 - camera.cy],
  )


def add_visual(spec: mujoco.MjSpec, *, mesh: str, texture: str) -> None:
  """Adds the textured surface mesh of two files in the asset folder; nothing collides with it."""
  spec.add_texture(name="visual", type=mujoco.mjtTexture.mjTEXTURE_2D, file=texture)
  material = spec.add_material(name="visual", specular=0, shininess=0)
  material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "visual"
  spec.add_mesh(name="visual", file=mesh, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
  spec.worldbody.add_geom(
    name="visual",
    type=mujoco.mjtGeom.mjGEOM_MESH,
    meshname="visual",
    material="visual",
    contype=0,
    conaffinity=0,
    group=VISUAL_GROUP,
  )


@dataclasses.dataclass(frozen=True)
class StandingRobot:
  """A robot on its own, and how it stands at the origin facing +x."""

  spec: mujoco.MjSpec  # its first body has no joint: a free one is added
  root: str  # name of that body
  pose: np.ndarray  # [7] position and quaternion of that body [m]
  angles: Mapping[str, float]  # of the hinges by name [rad]
  controls: np.ndarray  # of the actuators, in their order


def add_robot(spec: mujoco.MjSpec, robot: StandingRobot, place: np.ndarray) -> None:
  """Attaches a robot at a place x, y, yaw [3] [m, rad], with a keyframe "stand".

  Its elements' names begin with the robot's name and a slash.
  """
  prefix = f"{robot.spec.modelname}/"
  spec.attach(robot.spec, prefix=prefix, frame=spec.worldbody.add_frame())
  body = spec.body(prefix + robot.root)
  body.add_freejoint(name="root")
  x, y, yaw = place
  body.pos = np.array([x, y, 0]) + yaw_matrix(yaw) @ robot.pose[:3]
  mujoco.mju_mulQuat(body.quat, yaw_quaternion(yaw), robot.pose[3:])
  model = spec.compile()
  qpos = np.zeros(model.nq)
  qpos[:7] = [*body.pos, *body.quat]
  for name, angle in robot.angles.items():
    qpos[model.joint(prefix + name).qposadr[0]] = angle
  spec.add_key(name="stand", qpos=qpos, ctrl=robot.controls)


def write_obj(path: Path, mesh: TexturedMesh) -> None:
  """Writes a Wavefront file with texture coordinates."""
  lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in mesh.vertices]
  lines += [f"vt {u:.6f} {v:.6f}" for u, v in mesh.uv.reshape(-1, 2)]
  for number, face in enumerate(mesh.faces + 1):
    lines.append("f " + " ".join(f"{face[k]}/{3 * number + k + 1}" for k in range(3)))
  path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write(
  folder: Path, spec: mujoco.MjSpec, parts: Sequence[convex.Part], visual: TexturedMesh | None
) -> None:
  """Writes scene.xml and assets/ into a folder that appears whole or not at all.

  Args:
    folder: The folder; an older one is replaced.
    spec: From `scene_spec`, with what was added to it.
    parts: The parts of the specification, which become files.
    visual: The textured surface, or None.

  Raises:
    ValueError: MuJoCo cannot build the scene.
  """
  with files.atomic_folder(folder) as partial:
    assets = partial / "assets"
    assets.mkdir()
    collision.write_parts(parts, assets)
    for mesh in spec.meshes:
      if mesh.name.startswith("part_"):
        mesh.uservert, mesh.userface, mesh.file = [], [], f"{mesh.name}.obj"
    if visual is not None:
      write_obj(assets / "visual.obj", visual)
      write_picture(assets / "visual.png", visual.texture[..., ::-1])
      add_visual(spec, mesh="visual.obj", texture="visual.png")
    spec.compiler.meshdir = spec.compiler.texturedir = "assets"
    spec.modelfiledir = str(partial)
    spec.compile()
    (partial / "scene.xml").write_text(spec.to_xml(), encoding="utf-8")
