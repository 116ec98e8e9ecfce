"""Mass properties of a compiled model: adding point masses, and restoring the nominal values.

MuJoCo derives several arrays from the masses at compilation. `attach_mass` writes a body's mass,
centre of mass and inertia; `refresh` then recomputes what depends on them (mj_setConst). Nothing is
recompiled.
"""

import mujoco
import numpy as np

from nerf2real.core.geometry import rotations

Array = np.ndarray

# What attach_mass and mj_setConst may write (mujoco 3.17), apart from model.stat.
MASS_FIELDS = (
  "body_mass",
  "body_inertia",
  "body_ipos",
  "body_iquat",
  "body_sameframe",
  "body_simple",
  "body_subtreemass",
  "body_invweight0",
  "dof_M0",
  "dof_invweight0",
  "dof_length",
  "actuator_acc0",
  "actuator_length0",
  "tendon_length0",
  "tendon_invweight0",
  "bvh_aabb",
  "flexedge_length0",
  "flexedge_invweight0",
  "eq_data",
)
_SLIDES_ONLY = 2  # value of body_simple
_STATISTICS = ("meaninertia", "meanmass", "meansize", "extent")


class Snapshot:
  """A copy of some arrays of a compiled model, to put back exactly."""

  def __init__(self, model: mujoco.MjModel, fields: tuple[str, ...] = MASS_FIELDS):
    self._values = {
      name: getattr(model, name).copy()
      for name in fields
      if getattr(model, name, None) is not None and getattr(model, name).size
    }
    self._statistics = {name: getattr(model.stat, name) for name in _STATISTICS}
    self._center = model.stat.center.copy()

  def __getitem__(self, field: str) -> Array:
    return self._values[field]

  def restore(self, model: mujoco.MjModel) -> None:
    """Writes the copied values back."""
    for name, value in self._values.items():
      getattr(model, name)[:] = value
    self.restore_statistics(model)

  def restore_statistics(self, model: mujoco.MjModel) -> None:
    """Writes back model.stat only: mj_setConst changes it, and the renderer's depth uses it."""
    for name, value in self._statistics.items():
      setattr(model.stat, name, value)
    model.stat.center[:] = self._center


def combine_point_mass(
  mass: float, com: Array, inertia: Array, *, added: float, position: Array
) -> tuple[float, Array, Array]:
  """Adds a point mass to a rigid body: composite mass, centre of mass and inertia.

  Args:
    mass: of the body, kg.
    com: its centre of mass [3] in the body's frame, m.
    inertia: about its centre of mass, in the body's axes [3, 3], kg m^2.
    added: point mass, kg.
    position: where, in the body's frame [3], m.

  Returns:
    Mass, centre of mass [3] and inertia about it [3, 3] of the two together.
  """
  total = mass + added
  centre = (mass * com + added * position) / total

  def parallel_axis(m: float, offset: Array) -> Array:
    return m * (float(offset @ offset) * np.eye(3) - np.outer(offset, offset))

  combined = inertia + parallel_axis(mass, com - centre) + parallel_axis(added, position - centre)
  return total, centre, combined


def attach_mass(
  model: mujoco.MjModel, body: int, *, added: float, position: Array | tuple[float, ...]
) -> None:
  """Adds a point mass to a body of a compiled model, on top of what the body has now.

  Call `refresh` afterwards. Nothing is written for a mass of 0.

  Args:
    model: the model, changed in place.
    body: index of the body.
    added: kg.
    position: in the body's frame [3], m.

  Raises:
    ValueError: for an off-centre mass on a body whose inertia the compiled model keeps diagonal.
  """
  if added == 0:
    return
  position = np.asarray(position, np.float64)
  if model.body_simple[body] == _SLIDES_ONLY or np.array_equal(position, model.body_ipos[body]):
    # A body that only slides never turns: where the mass sits does not matter. At the centre of
    # mass it does not change the inertia.
    model.body_mass[body] += added
    return
  if model.body_simple[body]:
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body)
    raise ValueError(
      f"Found body {name!r} compiled as simple (diagonal inertia), to which an off-centre mass"
      ' cannot be added afterwards. Expected <body simple="false"> in its model, or the position of'
      f" its centre of mass, {model.body_ipos[body].tolist()}."
    )
  axes = rotations.matrix_from_quaternion(model.body_iquat[body])
  mass, com, inertia = combine_point_mass(
    float(model.body_mass[body]),
    model.body_ipos[body].copy(),
    axes @ np.diag(model.body_inertia[body]) @ axes.T,
    added=added,
    position=position,
  )
  moments, principal = np.linalg.eigh(inertia)
  if np.linalg.det(principal) < 0:
    principal[:, 0] *= -1
  model.body_mass[body] = mass
  model.body_ipos[body] = com
  model.body_inertia[body] = moments
  model.body_iquat[body] = rotations.quaternion_from_matrix(principal)
  # The compiler notes bodies whose inertial frame is the body's frame, to skip transforms.
  model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


def refresh(
  model: mujoco.MjModel, scratch: mujoco.MjData, snapshot: Snapshot | None = None
) -> None:
  """Recomputes what MuJoCo derives from the masses. `scratch` is overwritten.

  With a snapshot, model.stat stays as compiled: near and far planes of the renderer, and the depth
  values with them, must not depend on a payload.
  """
  mujoco.mj_setConst(model, scratch)
  if snapshot is not None:
    snapshot.restore_statistics(model)
