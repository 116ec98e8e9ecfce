"""The built-in room: a furnished room of 5 x 4 m whose geometry and pictures are known exactly.

`build_room` returns a MuJoCo specification to which a robot and a ball can be attached. Nothing in it
depends on the camera: the lights are fixed, the materials have no gloss.
"""

import functools

import cv2
import mujoco
import numpy as np

from real.virtual import art, furniture, solids, textures

PLANK_ROWS = 26
_AO_HEIGHTS = (0.04, 0.10, 0.25, 0.5)  # where occlusion is probed above a surface [m]
_AO_WEIGHTS = (0.16, 0.20, 0.24, 0.22)  # how dark each makes a corner; ours, by eye
_AO_STEP = 0.04  # grid of the probes [m]
_SHELL_PIXELS = 320  # texels per metre of floor and walls
_LIGHTS = (  # direction of travel, strength: a window in the west, bounce from everywhere else
  ((0.80, -0.15, -0.55), (0.40, 0.40, 0.38)),
  ((-0.20, 0.10, -1.00), (0.22, 0.215, 0.20)),
  ((-0.85, 0.35, -0.25), (0.14, 0.135, 0.125)),
  ((0.15, -0.95, -0.20), (0.17, 0.17, 0.165)),
  ((0.10, 0.95, -0.15), (0.15, 0.148, 0.14)),
  ((0.00, 0.05, 1.00), (0.18, 0.17, 0.155)),
)
_AMBIENT = 0.50


@functools.lru_cache(maxsize=4)
def room_solids(seed: int = 0) -> tuple[solids.Solid, ...]:
  """Returns every solid of the room; the same seed gives the same room."""
  return tuple(furniture.furnish(np.random.default_rng([seed, 1])))


def collision_truth(points: np.ndarray, *, seed: int = 0) -> np.ndarray:
  """Returns the signed distance from points [P, 3] to the room's surfaces [P] [m].

  Positive in free space, where it is exact; negative inside walls and furniture.
  """
  return solids.distance(list(room_solids(seed)), points)


def sample_surface(count: int, *, seed: int = 0, margin: float = 0.02):
  """Returns points on the surfaces that border free space, uniform by area.

  Args:
    count: Number of points N.
    seed: Seed of the room and of the choice of points.
    margin: Free space that must lie in front of a point along its normal [m].

  Returns:
    Points [N, 3] and outward normals [N, 3].
  """
  rng = np.random.default_rng([seed, 2])
  things = room_solids(seed)
  corners, normals = [], []
  for solid in things:
    mesh = solids.tessellate(solid)
    triangles = mesh.vertices[mesh.faces] @ solid.rotation.T + solid.position
    corners.append(triangles)
    normals.append(mesh.normals[mesh.faces].mean(1) @ solid.rotation.T)
  triangles, normals = np.concatenate(corners), np.concatenate(normals)
  area = np.linalg.norm(
    np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=-1
  )
  kept_points, kept_normals, found = [], [], 0
  half = np.array(furniture.ROOM_SIZE) / 2
  centre = np.array([0, 0, half[2]])
  while found < count:
    pick = rng.choice(len(triangles), 2 * count, p=area / area.sum())
    a, b = np.sqrt(rng.random((2 * count, 1))), rng.random((2 * count, 1))
    t = triangles[pick]
    points = (1 - a) * t[:, 0] + a * (1 - b) * t[:, 1] + a * b * t[:, 2]
    outward = normals[pick] / np.linalg.norm(normals[pick], axis=-1, keepdims=True)
    probe = points + margin * outward
    keep = (np.abs(probe - centre) < half).all(-1)
    keep[keep] = solids.distance(list(things), probe[keep]) > 0.8 * margin
    kept_points.append(points[keep])
    kept_normals.append(outward[keep])
    found += int(keep.sum())
  return np.concatenate(kept_points)[:count], np.concatenate(kept_normals)[:count]


def _occlusion(solid: solids.Solid, seed: int, shape: tuple[int, int]) -> np.ndarray:
  """Brightness [H, W] of the +z face of a panel: dark in corners and beside furniture."""
  half_x, half_y, half_z = solid.size
  columns, rows = (max(int(round(2 * s / _AO_STEP)), 2) for s in (half_x, half_y))
  x = (np.arange(columns) + 0.5) / columns * 2 * half_x - half_x
  y = half_y - (np.arange(rows) + 0.5) / rows * 2 * half_y
  grid = np.stack([*np.meshgrid(x, y), np.full((rows, columns), half_z)], -1).reshape(-1, 3)
  points = grid @ solid.rotation.T + solid.position
  light = np.ones(len(points))
  things = [s for s in room_solids(seed) if not s.name.startswith(("picture", "marker"))]
  for height, weight in zip(_AO_HEIGHTS, _AO_WEIGHTS, strict=True):
    gap = solids.distance(things, points + height * solid.rotation[:, 2])
    light *= 1 - weight * np.clip(1 - gap / height, 0, 1)
  picture = light.reshape(rows, columns).astype(np.float32)
  picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
  return cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_CUBIC)


def _floor(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
  picture = textures.planks(rng, shape, rows=PLANK_ROWS, dark=(112, 78, 48), light=(196, 152, 106))
  height, width = shape
  rug = textures.rug(rng, (int(1.7 * _SHELL_PIXELS), int(2.4 * _SHELL_PIXELS)))
  left, top = int((2.5 - 0.75) / 5 * width), int((2 - 0.72) / 4 * height)
  picture[top : top + rug.shape[0], left : left + rug.shape[1]] = rug
  return picture


@functools.lru_cache(maxsize=2)
def room_textures(seed: int = 0) -> dict[str, np.ndarray]:
  """Returns every texture of the room by name, uint8 [H, W, 3]."""
  rng = np.random.default_rng([seed, 3])
  x, y, z = (int(s * _SHELL_PIXELS) for s in furniture.ROOM_SIZE)
  small = (512, 512)
  named = {
    "floor": _floor(rng, (y, x)),
    "ceiling": textures.plaster(rng, (y, x), dark=(206, 203, 196), light=(240, 238, 232)),
    "wall_north": textures.plaster(rng, (z, x), dark=(150, 168, 172), light=(206, 216, 212)),
    "wall_south": textures.botanical(rng, (z, x), stems=150),
    "wall_east": textures.plaster(rng, (z, y), dark=(196, 166, 118), light=(234, 212, 170)),
    "wall_west": textures.bricks(rng, (z, y), rows=34, columns=18),
    "botanical": textures.botanical(rng, small, stems=24),
    "rug": textures.rug(rng, small),
    "pale_wood": textures.wood(rng, small, dark=(150, 114, 76), light=(216, 184, 140)),
    "dark_wood": textures.wood(rng, small, dark=(62, 42, 30), light=(124, 88, 62)),
    "red_wood": textures.wood(rng, small, dark=(104, 52, 32), light=(176, 104, 66)),
    "cloth_blue": textures.fabric(rng, small, dark=(48, 74, 96), light=(118, 146, 162)),
    "cloth_ochre": textures.fabric(rng, small, dark=(160, 112, 44), light=(224, 184, 104)),
    "slate": textures.plaster(rng, small, dark=(36, 38, 42), light=(92, 94, 98)),
    "glaze": textures.plaster(rng, small, dark=(120, 132, 138), light=(226, 226, 218)),
    "plaster": textures.plaster(rng, small, dark=(180, 178, 172), light=(236, 234, 228)),
    "soil": textures.plaster(rng, (128, 128), dark=(34, 24, 16), light=(96, 72, 50)),
    "leaf": textures.leaf(rng, (128, 256)),
    "cardboard": textures.cardboard(rng, small),
    "spines": art.spines(rng, (320, 64 * art.SPINES)),
    "window": art.window_view(rng, (480, 620)),
    "door": art.door(rng, (900, 380)),
    "marker": textures.marker(
      furniture.MARKER_ID, cell=40, margin_cells=furniture.MARKER_MARGIN_CELLS
    ),
  }
  shapes = [(560, 440), (380, 520), (480, 360), (640, 460), (520, 400), (640, 460), (560, 460), (390, 520)]
  for k, shape in enumerate(shapes):
    named[f"poster_{k}"] = art.poster(rng, shape, style=k % 4)
  for solid in room_solids(seed):
    if solid.name.startswith("shell") and solid.tiles is None:
      picture = named[solid.material]
      named[solid.material] = picture * _occlusion(solid, seed, picture.shape[:2])[..., None]
  return {name: textures.to_uint8(picture) for name, picture in named.items()}


def build_room(seed: int = 0) -> mujoco.MjSpec:
  """Returns the room as a MuJoCo specification: world frame z up, floor z = 0, metres.

  Visual meshes are in geom group 2 and collide with nothing; contact geoms are in group 3. A robot
  is attached with `spec.attach` or into a frame of `spec.worldbody`.
  """
  spec = mujoco.MjSpec()
  spec.modelname = "room"
  spec.visual.quality.shadowsize = 0
  spec.visual.quality.offsamples = 0
  spec.visual.global_.offwidth, spec.visual.global_.offheight = 2560, 2048
  spec.visual.map.znear, spec.visual.map.zfar = 0.01, 12.0
  spec.stat.extent, spec.stat.center = 1.0, [0, 0, 1]
  spec.visual.headlight.active = 0
  for name, picture in room_textures(seed).items():
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3)
    texture.height, texture.width = picture.shape[:2]
    texture.data = picture.tobytes()
    material = spec.add_material(name=name, specular=0.0, shininess=0.0, emission=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
  for k, (direction, strength) in enumerate(_LIGHTS):
    spec.worldbody.add_light(
      name=f"light_{k}", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, castshadow=False,
      pos=[0, 0, 2.4], dir=list(direction), diffuse=list(strength), specular=[0, 0, 0],
      ambient=[_AMBIENT / len(_LIGHTS)] * 3,
    )  # fmt: skip
  for solid in room_solids(seed):
    _add_solid(spec, solid)
  return spec


def _add_solid(spec: mujoco.MjSpec, solid: solids.Solid) -> None:
  mesh = solids.tessellate(solid)
  spec.add_mesh(
    name=solid.name,
    uservert=mesh.vertices.ravel(),
    usernormal=mesh.normals.ravel(),
    usertexcoord=mesh.texcoords.ravel(),
    userface=mesh.faces.ravel(),
    inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
  )
  quaternion = np.empty(4)
  mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(solid.rotation).ravel())
  place = {"pos": solid.position.tolist(), "quat": quaternion.tolist()}
  spec.worldbody.add_geom(
    name=f"{solid.name}_visual", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=solid.name,
    material=solid.material, rgba=[*np.clip(solid.tint, 0, 1), 1], group=2, contype=0,
    conaffinity=0, **place,
  )  # fmt: skip
  shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": solid.name}
  if solid.kind == "box" and not solid.rounding:
    shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": list(solid.size)}
  elif solid.kind == "ellipsoid":
    shape = {"type": mujoco.mjtGeom.mjGEOM_ELLIPSOID, "size": list(solid.size)}
  spec.worldbody.add_geom(name=f"{solid.name}_contact", group=3, **shape, **place)
