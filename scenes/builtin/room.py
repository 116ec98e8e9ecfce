"""The built-in room: a furnished room of 5 x 4 m whose geometry and pictures are known exactly.

`build_room` returns a MuJoCo specification to which a robot and a ball can be attached. Nothing
in it depends on the camera: the lights are fixed, the materials have no gloss.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from nerf2real.core.geometry import rotations
from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.builtin import furniture, solids, surfaces
from nerf2real.scenes.builtin.mujoco_renderer import Eye
from nerf2real.scenes.builtin.placing import ROOM_SIZE
from nerf2real.scenes.geometry import triangles

_MARGIN = 0.02  # free space before a point of the surface [m]
_TRUE_VIEW_ROWS = 960  # a true view is sampled with about this many rows
LIGHTS = (  # direction of travel, strength: a window in the west, bounce from everywhere else
  ((0.80, -0.15, -0.55), (0.40, 0.40, 0.38)),
  ((-0.20, 0.10, -1.00), (0.22, 0.215, 0.20)),
  ((-0.85, 0.35, -0.25), (0.14, 0.135, 0.125)),
  ((0.15, -0.95, -0.20), (0.17, 0.17, 0.165)),
  ((0.10, 0.95, -0.15), (0.15, 0.148, 0.14)),
  ((0.00, 0.05, 1.00), (0.18, 0.17, 0.155)),
)
AMBIENT = 0.50
_GLOW = {"window": 0.35}  # emission by texture


@dataclasses.dataclass(frozen=True, eq=False)
class TrueRoom:
  """A room whose surfaces are known: z up, floor z = 0, the origin in the middle of the floor."""

  solids: tuple[solids.Solid, ...]
  """All of it, walls and floor included."""
  size: tuple[float, float, float]
  """Along x, y and z [m]; all free space is within."""

  def distance(self, points: np.ndarray, *, limit: float = np.inf) -> np.ndarray:
    """Returns the signed distance from points [P, 3] to the room's surfaces [P] [m].

    Positive in free space, where it is exact; negative inside walls and furniture.
    """
    return solids.distance(self.solids, points, limit=limit)

  def surface(self, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns points on the surfaces that border free space, uniform by area.

    Args:
      count: Number of points N.

    Returns:
      Points [N, 3] and outward normals [N, 3].
    """
    rng = np.random.default_rng([0, 2])
    meshes = [(solids.tessellate(solid), solid) for solid in self.solids]
    faces = np.concatenate(
      [m.vertices[m.faces] @ solid.rotation.T + solid.position for m, solid in meshes]
    )
    normals = np.concatenate([m.normals[m.faces].mean(1) @ s.rotation.T for m, s in meshes])
    kept_points, kept_normals, found = [], [], 0
    half = np.array(self.size) / 2
    centre = np.array([0, 0, half[2]])
    while found < count:
      points, pick = triangles.draw(rng, faces, 2 * count)
      outward = normals[pick] / np.linalg.norm(normals[pick], axis=-1, keepdims=True)
      probe = points + _MARGIN * outward
      keep = (np.abs(probe - centre) < half).all(-1)
      keep[keep] = self.distance(probe[keep], limit=_MARGIN) > 0.8 * _MARGIN
      kept_points.append(points[keep])
      kept_normals.append(outward[keep])
      found += int(keep.sum())
    return np.concatenate(kept_points)[:count], np.concatenate(kept_normals)[:count]


@functools.lru_cache(maxsize=4)
def builtin(seed: int = 0) -> TrueRoom:
  """Returns the built-in room; the same seed gives the same room."""
  return TrueRoom(tuple(furniture.furnish(np.random.default_rng([seed, 1]))), ROOM_SIZE)


@functools.lru_cache(maxsize=2)
def _textures(seed: int) -> dict[str, np.ndarray]:
  return surfaces.paint(builtin(seed).solids, np.random.default_rng([seed, 3]))


def build_room(seed: int = 0, *, looks: bool = True) -> mujoco.MjSpec:
  """Returns the room as a MuJoCo specification: world frame z up, floor z = 0, metres.

  Visual meshes are in geom group 2 and collide with nothing; contact geoms are in group 3. A robot
  is attached with `spec.attach` or into a frame of `spec.worldbody`.

  Args:
    seed: The same seed gives the same room.
    looks: Whether it can be seen; painting takes 10 s, which a robot without a camera saves.
  """
  return assemble(builtin(seed).solids, _textures(seed) if looks else None)


def assemble(
  things: Sequence[solids.Solid],
  textures: Mapping[str, np.ndarray] | None,
  *,
  lights: Sequence[tuple[tuple[float, ...], tuple[float, ...]]] = LIGHTS,
  ambient: float = AMBIENT,
) -> mujoco.MjSpec:
  """Returns solids as a MuJoCo specification; see `build_room`.

  Args:
    things: All of a room.
    textures: Their materials by name, uint8 [H, W, 3]; None: they cannot be seen.
    lights: Direction of travel and colour of each.
    ambient: Light from everywhere.
  """
  spec = mujoco.MjSpec()
  spec.modelname = "room"
  spec.visual.quality.shadowsize = 0
  spec.visual.quality.offsamples = 0
  spec.visual.global_.offwidth, spec.visual.global_.offheight = 2560, 2048
  spec.visual.map.znear, spec.visual.map.zfar = 0.01, 12.0
  spec.stat.extent, spec.stat.center = 1.0, [0, 0, 1]
  spec.visual.headlight.active = 0
  for name, picture in (textures or {}).items():
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    texture.height, texture.width = picture.shape[:2]
    texture.data = picture.tobytes()
    glow = _GLOW.get(name, 0.0)
    material = spec.add_material(name=name, specular=0.0, shininess=0.0, emission=glow)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
  for k, (direction, strength) in enumerate(lights):
    spec.worldbody.add_light(
      name=f"light_{k}",
      type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
      castshadow=False,
      pos=[0, 0, 2.4],
      dir=list(direction),
      diffuse=list(strength),
      specular=[0, 0, 0],
      ambient=[ambient / len(lights)] * 3,
    )
  for solid in things:
    _add_solid(spec, solid, looks=textures is not None)
  return spec


def _add_solid(spec: mujoco.MjSpec, solid: solids.Solid, *, looks: bool) -> None:
  mesh = solids.tessellate(solid)
  spec.add_mesh(
    name=solid.name,
    uservert=mesh.vertices.ravel(),
    usernormal=mesh.normals.ravel(),
    usertexcoord=mesh.texcoords.ravel(),
    userface=mesh.faces.ravel(),
    inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
  )
  quaternion = rotations.quaternion_from_matrix(solid.rotation)
  place: dict[str, Any] = {"pos": solid.position.tolist(), "quat": quaternion.tolist()}
  if looks:
    spec.worldbody.add_geom(
      name=f"{solid.name}_visual",
      type=mujoco.mjtGeom.mjGEOM_MESH,
      meshname=solid.name,
      material=solid.material,
      rgba=[*np.clip(solid.tint, 0, 1), 1],
      group=2,
      contype=0,
      conaffinity=0,
      **place,
    )
  shape: dict[str, Any] = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": solid.name}
  if solid.kind == "box" and not solid.rounding:
    shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": list(solid.size)}
  elif solid.kind == "ellipsoid":
    shape = {"type": mujoco.mjtGeom.mjGEOM_ELLIPSOID, "size": list(solid.size)}
  spec.worldbody.add_geom(name=f"{solid.name}_contact", group=3, **shape, **place)


def true_view(
  camera: Camera, world_from_camera: np.ndarray, *, seed: int = 0, eye: Eye | None = None
) -> tuple[np.ndarray, np.ndarray]:
  """Renders the true picture through a lens: each pixel is the mean over its area.

  Args:
    camera: Any OPENCV camera.
    world_from_camera: Pose [4, 4] in the room, OpenCV axes.
    seed: Seed of the room.
    eye: A renderer to use again; without it one is made for this call (about 1 s, and building the
      room takes a few more the first time).

  Returns:
    Colour uint8 [H, W, 3] and z-depth float32 [H, W] [m].
  """
  if eye is None:
    with room_eye(seed) as own:
      return true_view(camera, world_from_camera, eye=own)
  supersample = int(np.clip(np.ceil(_TRUE_VIEW_ROWS / camera.height), 2, 64))
  return eye.render(camera, world_from_camera, supersample=supersample)


@functools.lru_cache(maxsize=2)
def _compiled(seed: int) -> mujoco.MjModel:
  return build_room(seed).compile()


def room_eye(seed: int = 0) -> Eye:
  """Returns a renderer of the room, for many calls of `true_view`; close it after use."""
  return Eye(_compiled(seed))
