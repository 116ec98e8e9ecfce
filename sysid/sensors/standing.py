"""What a robot stands on, from its joints: the face of its hull below its centre of mass.

Shapes: V points.
"""

import itertools

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

Array = np.ndarray

_G = mujoco.mjtGeom
_ROUND = 12  # points around a round geom


def floor(model: mujoco.MjModel) -> str | None:
  """Returns the name of the first plane that is fixed to the world; None without one."""
  for index in range(model.ngeom):
    fixed = model.body_weldid[model.geom_bodyid[index]] == 0
    if int(model.geom_type[index]) == int(_G.mjGEOM_PLANE) and fixed:
      return model.geom(index).name
  return None


def normal(model: mujoco.MjModel, data: mujoco.MjData, body: int, up: Array) -> Array | None:
  """Returns the normal [3] of the plane that a body stands on, upwards, in its own frame.

  Gravity holds it on the face of the hull of its geoms that is met from its centre of mass.

  Args:
    model: compiled.
    data: positions are computed.
    body: that moves freely; it and its descendants stand.
    up: against gravity [3] in the body's frame.

  Returns:
    The normal; None where the geoms span no volume.
  """
  turn, place = data.xmat[body].reshape(3, 3), data.xpos[body]
  points = (_points(model, data, body) - place) @ turn
  centre = (data.subtree_com[body] - place) @ turn
  if len(points) < 4:
    return None
  try:
    hull = ConvexHull(points)
  except QhullError:
    return None
  outward, offset = hull.equations[:, :3], hull.equations[:, 3]
  fall = -outward @ up
  height = -(outward @ centre + offset)  # above each face
  with np.errstate(divide="ignore", invalid="ignore"):
    reach = np.where(fall > 1e-6, height / fall, np.inf)
  met = int(np.argmin(reach))
  return -outward[met] if np.isfinite(reach[met]) else None


def lowest(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
  """Returns the height [m] of the lowest point of a body and its descendants."""
  return float(_points(model, data, body)[:, 2].min())


def _points(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Array:
  """Returns points [V, 3] of the geoms that touch things, of a body and its descendants."""
  found = [np.zeros((0, 3))]
  for index in range(model.ngeom):
    owner = int(model.geom_bodyid[index])
    if model.body_rootid[owner] != model.body_rootid[body]:
      continue
    if not (model.geom_contype[index] or model.geom_conaffinity[index]):
      continue
    own = _own_points(model, index)
    found.append(own @ data.geom_xmat[index].reshape(3, 3).T + data.geom_xpos[index])
  return np.concatenate(found)


def _own_points(model: mujoco.MjModel, geom: int) -> Array:
  """Returns points [V, 3] of a geom's hull in its own frame."""
  kind, size = int(model.geom_type[geom]), model.geom_size[geom]
  signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
  around = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
  circle = np.stack([np.cos(around), np.sin(around), np.zeros(_ROUND)], axis=1)
  if kind == int(_G.mjGEOM_BOX):
    return signs * size
  if kind == int(_G.mjGEOM_MESH):
    mesh = int(model.geom_dataid[geom])
    first = int(model.mesh_vertadr[mesh])
    return np.asarray(model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])], np.float64)
  if kind == int(_G.mjGEOM_CYLINDER):
    ends = size[1] * np.array([[0, 0, 1.0], [0, 0, -1]])
    return np.concatenate([size[0] * circle + end for end in ends])
  ball = np.concatenate([circle, np.roll(circle, 1, axis=1), np.roll(circle, 2, axis=1)])
  if kind == int(_G.mjGEOM_SPHERE):
    return size[0] * ball
  if kind == int(_G.mjGEOM_CAPSULE):
    ends = size[1] * np.array([[0, 0, 1.0], [0, 0, -1]])
    return np.concatenate([size[0] * ball + end for end in ends])
  if kind == int(_G.mjGEOM_ELLIPSOID):
    return size * ball
  return np.zeros((0, 3))
