"""A compiled model as effects see it: joints and actuators by name, and shared work arrays.

Works for any MuJoCo model: joints are its hinge and slide joints; actuators are position, motor or
other affine ones that drive such a joint.

Shapes: J joints of the binding, U actuators of the model.
"""

import difflib
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from nerf2real.suite.randomisation import inertia

Array = np.ndarray
_LISTED = 30  # names in an error message

# Every array of the model that some effect writes, apart from the mass properties.
_FIELDS = (
  *inertia.MASS_FIELDS,
  "body_gravcomp",
  "dof_damping",
  "dof_dampingpoly",
  "dof_frictionloss",
  "dof_solimp",
  "dof_armature",
  "jnt_stiffness",
  "qpos_spring",
  "actuator_gainprm",
  "actuator_biasprm",
  "actuator_forcelimited",
  "actuator_forcerange",
  "geom_quat",
  "geom_sameframe",
  "geom_friction",
  "geom_condim",
  "geom_priority",
  "pair_friction",
  "pair_dim",
)


def unknown_name(noun: str, name: str, names: Sequence[str]) -> ValueError:
  """Returns the error for a name that the model lacks, with the names near it."""
  known = [n for n in names if n]
  near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
  listed = near or known[:_LISTED]
  what = "did you mean" if near else "expected one of"
  return ValueError(f"Found no {noun} named {name!r} in the model, {what} {listed}?")


class Binding:
  """What the operators of one stack share."""

  def __init__(self, model: mujoco.MjModel, joints: Sequence[str] | None = None):
    """Looks the joints up and notes the model's values.

    Args:
      model: compiled model; effects write to it.
      joints: names of the joints, in the order of the measured joint arrays; all hinge and slide
        joints in the model's order if None.
    """
    self.model = model
    single = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    every = [i for i in range(model.njnt) if int(model.jnt_type[i]) in single]
    names = {_name(model, mujoco.mjtObj.mjOBJ_JOINT, i): i for i in every}
    if joints is None:
      joints = list(names)
    for name in joints:
      if name not in names:
        raise unknown_name("hinge or slide joint", name, list(names))
    self.joints = list(joints)
    self.joint_ids = np.array([names[name] for name in joints], int)
    self.qpos = _as_slice(model.jnt_qposadr[self.joint_ids])
    self.dofs = _as_slice(model.jnt_dofadr[self.joint_ids])
    self.timestep = float(model.opt.timestep)
    self.snapshot = inertia.Snapshot(model, _FIELDS)
    self.gravity = model.opt.gravity.copy()
    self.masses_changed = False
    self.loaded = np.zeros(model.nbody, bool)
    """Which bodies carry what is not declared."""
    self._find_actuators()

    num_joints, num_actuators = len(self.joints), model.nu
    self.position = np.zeros(num_joints)
    self.velocity = np.zeros(num_joints)
    self.encoder_offset = np.zeros(num_joints)
    """What the encoder always reads beyond the joint's position, rad."""
    self.force = np.zeros(num_joints)
    """Generalised force that the effects add, N m."""
    self.friction = np.zeros(num_joints)
    """Dry friction that the effects add at this step, N m."""
    self.encoder_shift = np.zeros(num_joints)
    """What the encoder reads beyond the joint's position, rad."""
    self.strength = np.ones(num_actuators)
    """Factor on the actuators' force at this step."""
    self.limit = np.ones(num_actuators)
    """Factor on the actuators' limits at this step."""
    self.ctrl = np.zeros(num_actuators)
    self.simulated = np.ones(num_actuators, bool)
    """Which actuators act in MuJoCo [U]: the others' motors are an effect's."""
    self.last_force = np.zeros(num_actuators)
    """Force of every actuator in the last step [U]."""
    self.reach = np.zeros(num_joints)
    """By which contacts bend under the constant dry friction before they slide, rad; 0 for none."""
    self.geared = np.zeros(num_joints, bool)
    """Which joints have a motor of their own behind play: an effect's, as its friction is."""
    self._diagonal = (model.M_rowadr + model.M_rownnz - 1)[self.dofs]
    self.data: Any = None
    """mujoco.MjData of the step."""

  def _find_actuators(self) -> None:
    model = self.model
    by_joint = {int(j): i for i, j in enumerate(self.joint_ids)}
    on_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    self.actuator_joint = np.array(
      [
        by_joint.get(int(model.actuator_trnid[u, 0]), -1) if on_joint[u] else -1
        for u in range(model.nu)
      ],
      int,
    )
    """Index into the joints [U], -1 for an actuator that drives none of them."""
    self.gear = model.actuator_gear[:, 0].copy()
    self.affine = (
      (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED))
      & (model.actuator_biastype != int(mujoco.mjtBias.mjBIAS_MUSCLE))
      & (model.actuator_biastype != int(mujoco.mjtBias.mjBIAS_USER))
    )

  def joint_index(self, target: str | None) -> int | slice:
    """Returns the index of a joint among the binding's, or all of them for None."""
    if target is None:
      return slice(None)
    if target in self.joints:
      return self.joints.index(target)
    raise unknown_name("hinge or slide joint", target, self.joints)

  def actuator_indices(self, target: str | None) -> Array:
    """Returns the indices of the actuators of that name, or that drive the joint of that name."""
    model = self.model
    if target is None:
      return np.arange(model.nu)
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, target)
    if index >= 0:
      found = np.array([index])
    else:
      found = np.flatnonzero(self.actuator_joint == self.joint_index(target))
      if not len(found):
        raise ValueError(f"Found no actuator that drives the joint {target!r}, expected one.")
    if not self.affine[found].all():
      raise ValueError(
        f"Found an actuator of {target!r} that is not of the position, velocity or motor form"
        " (fixed gain, affine bias), which effects on actuators expect."
      )
    return found

  def index(self, noun: str, target: str) -> int:
    """Returns the index of a named body or geom of the model."""
    kind = {"body": mujoco.mjtObj.mjOBJ_BODY, "geom": mujoco.mjtObj.mjOBJ_GEOM}[noun]
    index = mujoco.mj_name2id(self.model, kind, target)
    if index < 0:
      count = self.model.nbody if noun == "body" else self.model.ngeom
      raise unknown_name(noun, target, [_name(self.model, kind, i) for i in range(count)])
    return index

  def note_constants(self) -> None:
    """Notes actuators and friction after all constant effects are written."""
    model = self.model
    self._gain_view = model.actuator_gainprm[:, 0]
    self._bias_view = model.actuator_biasprm[:, :3]
    self._gain, self._bias = self._gain_view.copy(), self._bias_view.copy()
    self._bias_constant = self._bias[:, 0].copy()
    self._dry_friction = model.dof_frictionloss[self.dofs].copy()
    self._of_joint = np.maximum(self.actuator_joint, 0)
    # One actuator a joint, in the same order: no gathering needed.
    if np.array_equal(self.actuator_joint, np.arange(len(self.joints))):
      self._of_joint = slice(None)
    on_joint = self.actuator_joint >= 0
    self._per_position = np.where(on_joint, self._bias[:, 1] * self.gear, 0.0)
    self._per_velocity = np.where(on_joint, self._bias[:, 2] * self.gear, 0.0)
    self._uses_velocity = bool(self._per_velocity.any())
    self._ctrl_low, self._ctrl_high = _limits(model.actuator_ctrllimited, model.actuator_ctrlrange)
    self._low, self._high = _limits(model.actuator_forcelimited, model.actuator_forcerange)
    self._forcerange = model.actuator_forcerange.copy()
    self._written_limit = np.ones(model.nu)
    self._work = np.zeros(model.nu)

  def clear(self) -> None:
    """Forgets what effects added and scaled in the last step."""
    self.force.fill(0.0)
    self.friction.fill(0.0)
    self.encoder_shift.fill(0.0)
    self.strength.fill(1.0)
    self.limit.fill(1.0)

  def write_actuators(self, *, shifted: bool) -> None:
    """Writes strength, and encoder shift if `shifted`, into the model's actuator constants."""
    strength = self.strength
    np.multiply(self._gain, strength, out=self._gain_view)
    if (self.limit != self._written_limit).any():
      np.multiply(self._forcerange, self.limit[:, None], out=self.model.actuator_forcerange)
      self._written_limit[:] = self.limit
    np.multiply(self._bias, strength[:, None], out=self._bias_view)
    if shifted and len(self.joints):
      shift = self._per_position * self.encoder_shift[self._of_joint]
      shift *= strength
      self._bias_view[:, 0] += shift

  def write_friction(self) -> None:
    """Writes this step's dry friction into the model."""
    self.model.dof_frictionloss[self.dofs] = self._dry_friction + self.friction

  def note_last_force(self) -> None:
    """Notes the forces of the last step, of the actuators that act in MuJoCo."""
    np.copyto(self.last_force, self.data.actuator_force, where=self.simulated)

  def actuator_torque(self) -> Array:
    """Returns the actuators' torque on every joint [J] in the last step."""
    torque = self.data.qfrc_actuator[self.dofs].copy()
    others = np.flatnonzero(~self.simulated)
    np.add.at(torque, self.actuator_joint[others], self.last_force[others] * self.gear[others])
    return torque

  def actuator_force(self, position: Array, velocity: Array) -> tuple[Array, Array]:
    """Returns the force [U] that the actuators give at joint positions and velocities [J], and how
    it changes with the velocity of their joint [U], zero where they saturate."""
    ctrl = self.ctrl
    if self._ctrl_low is not None and self._ctrl_high is not None:
      ctrl = np.minimum(np.maximum(ctrl, self._ctrl_low), self._ctrl_high)
    force = self._gain * ctrl
    force += self._bias_constant
    force += np.multiply(self._per_position, position[self._of_joint], out=self._work)
    if self._uses_velocity:
      force += np.multiply(self._per_velocity, velocity[self._of_joint], out=self._work)
    force *= self.strength
    slope = self._per_velocity * self.strength
    if self._low is not None and self._high is not None:
      low, high = self._low * self.limit, self._high * self.limit
      slope[(force <= low) | (force >= high)] = 0.0
      force = np.minimum(np.maximum(force, low), high)
    return force, slope

  def inertia(self) -> Array:
    """Returns the inertia of every joint [J] with its armature in the last step, kg m^2."""
    inertia = self.data.M[self._diagonal]
    return np.where(inertia > 0, inertia, self.model.dof_M0[self.dofs])

  def restore(self) -> None:
    """Writes back every value noted when the binding was made."""
    self.snapshot.restore(self.model)
    self.model.opt.gravity[:] = self.gravity


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
  return mujoco.mj_id2name(model, kind, index) or ""


def _as_slice(indices: Array) -> Array | slice:
  """Returns consecutive indices as a slice, which numpy reads faster."""
  if len(indices) and np.array_equal(indices, np.arange(indices[0], indices[0] + len(indices))):
    return slice(int(indices[0]), int(indices[0]) + len(indices))
  return np.array(indices, int)


def _limits(limited: Array, ranges: Array) -> tuple[Array | None, Array | None]:
  """Returns lower and upper limits, infinite where an actuator has none; None if none has."""
  if not limited.any():
    return None, None
  chosen = limited.astype(bool)
  return np.where(chosen, ranges[:, 0], -np.inf), np.where(chosen, ranges[:, 1], np.inf)
