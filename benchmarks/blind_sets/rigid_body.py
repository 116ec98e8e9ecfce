"""Dynamics of a tree of hinged rigid bodies on a fixed base, compiled with numba.

Spatial vectors [6] are (angular, linear) at the world's origin and along the world's axes, so that
inertias and forces of subtrees add without transformation (Featherstone 2008, chapters 2, 5 and 6:
recursive Newton-Euler for the bias, composite rigid bodies for the mass matrix). J joints.
"""

from typing import NamedTuple

import mujoco
import numba
import numpy as np


class Tree(NamedTuple):
  """Bodies in an order in which parents come before children; one hinge a body, at its origin."""

  parent: np.ndarray
  """[J] index of the parent, -1 for the base."""
  offset: np.ndarray
  """[J, 3] m, origin in the parent's frame (world's where there is no parent)."""
  rotation: np.ndarray
  """[J, 3, 3] frame in the parent's frame at joint angle 0."""
  axis: np.ndarray
  """[J, 3] unit vector of the hinge in the body's frame."""
  mass: np.ndarray
  """[J] kg."""
  center: np.ndarray
  """[J, 3] m, centre of mass in the body's frame."""
  inertia: np.ndarray
  """[J, 3, 3] kg m^2 about the centre of mass, along the body's axes."""


class Work(NamedTuple):
  """Scratch arrays, so that a step allocates nothing."""

  position: np.ndarray  # [J, 3]
  rotation: np.ndarray  # [J, 3, 3]
  motion: np.ndarray  # [J, 6] joint axes as spatial vectors
  velocity: np.ndarray  # [J, 6]
  acceleration: np.ndarray  # [J, 6]
  force: np.ndarray  # [J, 6]
  moment: np.ndarray  # [J, 3] mass times centre of mass
  about_origin: np.ndarray  # [J, 3, 3] rotational inertia about the world's origin
  mass: np.ndarray  # [J] of the subtree
  matrix: np.ndarray  # [J, J]
  bias: np.ndarray  # [J]


def read_tree(model: mujoco.MjModel) -> Tree:
  """Returns the tree that a model declares.

  Raises:
    ValueError: a moving body without exactly one hinge at its origin.
  """
  rows: dict[int, int] = {}
  columns: list[list[np.ndarray | float | int]] = []
  for joint in range(model.njnt):
    body = int(model.jnt_bodyid[joint])
    parent = int(model.body_parentid[body])
    if model.body_jntnum[body] != 1 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
      raise ValueError(f"Body {model.body(body).name!r} needs exactly one hinge.")
    if np.any(model.jnt_pos[joint]):
      raise ValueError(f"Joint {model.joint(joint).name!r} must be at its body's origin.")
    offset, rotation = model.body_pos[body].copy(), _matrix(model.body_quat[body])
    while parent != 0 and parent not in rows:  # bodies welded to the world
      if model.body_jntnum[parent]:
        raise ValueError(f"Body {model.body(parent).name!r} must come before its children.")
      turn = _matrix(model.body_quat[parent])
      offset, rotation = model.body_pos[parent] + turn @ offset, turn @ rotation
      parent = int(model.body_parentid[parent])
    rows[body] = joint
    principal = _matrix(model.body_iquat[body])
    columns.append(
      [
        rows.get(parent, -1),
        offset,
        rotation,
        model.jnt_axis[joint].copy(),
        float(model.body_mass[body]),
        model.body_ipos[body].copy(),
        principal @ np.diag(model.body_inertia[body]) @ principal.T,
      ]
    )
  return Tree(*(np.array(column) for column in zip(*columns, strict=True)))


def attach_point_mass(tree: Tree, body: int, mass: float, position: np.ndarray) -> Tree:
  """Returns the tree with a point mass [kg] on a body, at a position [3] in the body's frame."""
  total = tree.mass[body] + mass
  center = (tree.mass[body] * tree.center[body] + mass * position) / total
  inertia = tree.inertia.copy()
  inertia[body] += _point_inertia(tree.mass[body], tree.center[body] - center)
  inertia[body] += _point_inertia(mass, position - center)
  masses, centers = tree.mass.copy(), tree.center.copy()
  masses[body], centers[body] = total, center
  return tree._replace(mass=masses, center=centers, inertia=inertia)


def make_work(count: int) -> Work:
  """Returns scratch arrays for a tree of `count` joints."""
  return Work(
    np.zeros((count, 3)),
    np.zeros((count, 3, 3)),
    np.zeros((count, 6)),
    np.zeros((count, 6)),
    np.zeros((count, 6)),
    np.zeros((count, 6)),
    np.zeros((count, 3)),
    np.zeros((count, 3, 3)),
    np.zeros(count),
    np.zeros((count, count)),
    np.zeros(count),
  )


def _point_inertia(mass: float, arm: np.ndarray) -> np.ndarray:
  return mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))


def _matrix(quaternion: np.ndarray) -> np.ndarray:
  """Returns the rotation matrix [3, 3] of a unit quaternion (w, x, y, z)."""
  w, x, y, z = quaternion / np.linalg.norm(quaternion)
  return np.array(
    [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
  )


@numba.njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _cross(ax, ay, az, bx, by, bz):
  return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _place(tree, q, work):
  """Writes frames, joint axes and inertias about the world's origin."""
  local = np.empty((3, 3))
  for i in range(len(q)):
    p = tree.parent[i]
    ux, uy, uz = tree.axis[i]
    c, s = np.cos(q[i]), np.sin(q[i])
    k = 1 - c
    turn = (
      (c + ux * ux * k, ux * uy * k - uz * s, ux * uz * k + uy * s),
      (uy * ux * k + uz * s, c + uy * uy * k, uy * uz * k - ux * s),
      (uz * ux * k - uy * s, uz * uy * k + ux * s, c + uz * uz * k),
    )
    for a in range(3):
      for b in range(3):
        total = 0.0
        for d in range(3):
          total += tree.rotation[i, a, d] * turn[d][b]
        local[a, b] = total
    for a in range(3):
      if p < 0:
        work.position[i, a] = tree.offset[i, a]
        for b in range(3):
          work.rotation[i, a, b] = local[a, b]
      else:
        total = work.position[p, a]
        for d in range(3):
          total += work.rotation[p, a, d] * tree.offset[i, d]
        work.position[i, a] = total
        for b in range(3):
          total = 0.0
          for d in range(3):
            total += work.rotation[p, a, d] * local[d, b]
          work.rotation[i, a, b] = total
    r = work.rotation[i]
    # The axis is the same before and after the turn about itself.
    ax = r[0, 0] * ux + r[0, 1] * uy + r[0, 2] * uz
    ay = r[1, 0] * ux + r[1, 1] * uy + r[1, 2] * uz
    az = r[2, 0] * ux + r[2, 1] * uy + r[2, 2] * uz
    x, y, z = work.position[i]
    mx, my, mz = _cross(x, y, z, ax, ay, az)
    work.motion[i, 0], work.motion[i, 1], work.motion[i, 2] = ax, ay, az
    work.motion[i, 3], work.motion[i, 4], work.motion[i, 5] = mx, my, mz
    m = tree.mass[i]
    cx, cy, cz = tree.center[i]
    cx, cy, cz = (
      x + r[0, 0] * cx + r[0, 1] * cy + r[0, 2] * cz,
      y + r[1, 0] * cx + r[1, 1] * cy + r[1, 2] * cz,
      z + r[2, 0] * cx + r[2, 1] * cy + r[2, 2] * cz,
    )
    work.mass[i] = m
    work.moment[i, 0], work.moment[i, 1], work.moment[i, 2] = m * cx, m * cy, m * cz
    square = cx * cx + cy * cy + cz * cz
    point = (cx, cy, cz)
    for a in range(3):
      for b in range(3):
        local[a, b] = 0.0
        for d in range(3):
          local[a, b] += r[a, d] * tree.inertia[i, d, b]
    for a in range(3):
      for b in range(3):
        total = -m * point[a] * point[b]
        if a == b:
          total += m * square
        for d in range(3):
          total += local[a, d] * r[b, d]
        work.about_origin[i, a, b] = total


@numba.njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _momentum(work, i, v):
  """Returns the spatial momentum (6 numbers) of inertia i moving with spatial velocity v."""
  wx, wy, wz, vx, vy, vz = v[0], v[1], v[2], v[3], v[4], v[5]
  hx, hy, hz = work.moment[i]
  inertia = work.about_origin[i]
  m = work.mass[i]
  lx, ly, lz = _cross(wx, wy, wz, hx, hy, hz)
  nx, ny, nz = _cross(hx, hy, hz, vx, vy, vz)
  return (
    inertia[0, 0] * wx + inertia[0, 1] * wy + inertia[0, 2] * wz + nx,
    inertia[1, 0] * wx + inertia[1, 1] * wy + inertia[1, 2] * wz + ny,
    inertia[2, 0] * wx + inertia[2, 1] * wy + inertia[2, 2] * wz + nz,
    m * vx + lx,
    m * vy + ly,
    m * vz + lz,
  )


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def dynamics(tree, q, qd, gravity, work):
  """Writes mass matrix and bias of `matrix qdd + bias = torque` into `work`.

  Args:
    tree: the bodies.
    q: [J] rad.
    qd: [J] rad/s.
    gravity: [3] m/s^2 along the world's axes.
    work: scratch; `matrix` [J, J] and `bias` [J] (gravity, Coriolis, centrifugal) are the result.
  """
  count = len(q)
  _place(tree, q, work)
  for i in range(count):
    p = tree.parent[i]
    s, v, a = work.motion[i], work.velocity[i], work.acceleration[i]
    for k in range(6):
      v[k] = s[k] * qd[i]
      a[k] = 0.0
    if p < 0:
      for k in range(3):
        a[3 + k] = -gravity[k]
    else:
      for k in range(6):
        v[k] += work.velocity[p, k]
        a[k] = work.acceleration[p, k]
    # v x (s qd): the axis turns with the body.
    x, y, z = _cross(v[0], v[1], v[2], s[0], s[1], s[2])
    a[0] += x * qd[i]
    a[1] += y * qd[i]
    a[2] += z * qd[i]
    x, y, z = _cross(v[0], v[1], v[2], s[3], s[4], s[5])
    bx, by, bz = _cross(v[3], v[4], v[5], s[0], s[1], s[2])
    a[3] += (x + bx) * qd[i]
    a[4] += (y + by) * qd[i]
    a[5] += (z + bz) * qd[i]
    f = _momentum(work, i, a)
    h = _momentum(work, i, v)
    nx, ny, nz = _cross(v[0], v[1], v[2], h[0], h[1], h[2])
    mx, my, mz = _cross(v[3], v[4], v[5], h[3], h[4], h[5])
    lx, ly, lz = _cross(v[0], v[1], v[2], h[3], h[4], h[5])
    work.force[i, 0] = f[0] + nx + mx
    work.force[i, 1] = f[1] + ny + my
    work.force[i, 2] = f[2] + nz + mz
    work.force[i, 3] = f[3] + lx
    work.force[i, 4] = f[4] + ly
    work.force[i, 5] = f[5] + lz
  for i in range(count - 1, -1, -1):
    s = work.motion[i]
    total = 0.0
    for k in range(6):
      total += s[k] * work.force[i, k]
    work.bias[i] = total
    # All children have been added: this is the composite body of the subtree.
    f = _momentum(work, i, s)
    j = i
    while j >= 0:
      u = work.motion[j]
      entry = u[0] * f[0] + u[1] * f[1] + u[2] * f[2] + u[3] * f[3] + u[4] * f[4] + u[5] * f[5]
      work.matrix[i, j] = entry
      work.matrix[j, i] = entry
      j = tree.parent[j]
    p = tree.parent[i]
    if p >= 0:
      work.mass[p] += work.mass[i]
      for a in range(6):
        work.force[p, a] += work.force[i, a]
      for a in range(3):
        work.moment[p, a] += work.moment[i, a]
        for b in range(3):
          work.about_origin[p, a, b] += work.about_origin[i, a, b]


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def solve(parent, matrix, right):
  """Solves a tree's `matrix x = right` in place: `matrix` becomes its factor, `right` becomes x.

  L^T L factorisation along the ancestors only (Featherstone 2008, table 6.3): joints of different
  branches have no entry in common.
  """
  count = len(right)
  for k in range(count - 1, -1, -1):
    matrix[k, k] = np.sqrt(matrix[k, k])
    i = parent[k]
    while i >= 0:
      matrix[k, i] /= matrix[k, k]
      i = parent[i]
    i = parent[k]
    while i >= 0:
      j = i
      while j >= 0:
        matrix[i, j] -= matrix[k, i] * matrix[k, j]
        j = parent[j]
      i = parent[i]
  for i in range(count - 1, -1, -1):
    right[i] /= matrix[i, i]
    j = parent[i]
    while j >= 0:
      right[j] -= matrix[i, j] * right[i]
      j = parent[j]
  for i in range(count):
    j = parent[i]
    while j >= 0:
      right[i] -= matrix[i, j] * right[j]
      j = parent[j]
    right[i] /= matrix[i, i]
