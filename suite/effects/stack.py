"""A list of effects, bound to a model: called once a physics step and once a measurement."""

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from nerf2real.suite.effects import files
from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.compensation import unknown_to_firmware
from nerf2real.suite.effects.effect import Array, Effect, Operator
from nerf2real.suite.effects.registry import KINDS
from nerf2real.suite.randomisation import inertia


class EffectStack:
  """Effects at work in one model.

      stack = EffectStack(effects).bind(model)
      stack.reset()                       # at the start of every episode
      stack.before_step(data, ctrl)       # instead of data.ctrl[:] = ctrl, before every mj_step
      seen = stack.observe("joint_positions", data.qpos[...], data.time)

  Binding writes the constant effects into the compiled model, `unbind` restores it. The stack owns
  `data.ctrl`, and `data.qfrc_applied` of its joints if it has forces (use `data.xfrc_applied` for
  pushes). dm_control's physics.model and physics.data are taken as well as MuJoCo's own.
  """

  def __init__(self, effects: Iterable[Effect] = ()):
    self.effects = list(effects)
    for effect in self.effects:
      files.check(effect)
    self.binding: Binding | None = None
    self.operators: list[Operator] = []

  def bind(self, model: Any, *, joints: Sequence[str] | None = None) -> "EffectStack":
    """Puts the effects into a compiled model and returns self.

    Args:
      model: mujoco.MjModel (or dm_control's wrapper of one), changed in place.
      joints: names in the order of the measured joint arrays; all hinge and slide joints if None.

    Raises:
      ValueError: for a target that the model lacks, naming those near it. The model is then as it
        was.
    """
    model = getattr(model, "ptr", model)
    binding = Binding(model, joints)
    operators = []
    try:
      for kind in KINDS.values():
        chosen = [effect for effect in self.effects if effect.kind == kind.name]
        if chosen:
          operators.append(kind.operator(chosen))
          operators[-1].bind(binding)
      if binding.masses_changed:
        inertia.refresh(model, mujoco.MjData(model), binding.snapshot)
    except ValueError:
      binding.restore()
      raise
    binding.note_constants()
    self._lift = unknown_to_firmware(binding)
    self.binding, self.operators = binding, operators
    self._commands = [op for op in operators if op.overrides("command")]
    self._steps = [op for op in operators if op.overrides("step")]
    self._observers = [op for op in operators if op.overrides("observe")]
    self._stamps = [op for op in operators if op.overrides("stamp")]
    acts = {op.kind.name: op.kind.acts for op in self._steps}
    self._adds_friction = bool(acts.keys() & {"stribeck_friction", "load_friction", "presliding"})
    self._adds_force = any(op.kind.law for op in self._steps) or bool(
      acts.keys() & {"asymmetric_friction", "presliding", "cogging", "residual_force", "backlash"}
    )
    self._scales = "actuator" in acts.values()
    self._shifts = "backlash" in acts
    self.reset()
    return self

  def unbind(self) -> None:
    """Restores the model, bit for bit."""
    if self.binding is not None:
      self.binding.restore()
      self.binding = None

  @property
  def is_constant(self) -> bool:
    """True if the bound model alone holds all that acts on the motion: plain stepping will do."""
    return not self._commands and not self._steps and self._lift is None

  def operator(self, kind: str) -> Operator | None:
    """Returns the operator of a kind, None if the stack has none."""
    return next((op for op in self.operators if op.kind.name == kind), None)

  def reset(self, ctrl: Array | None = None) -> None:
    """Starts an episode: empties delays, cools motors, closes gaps.

    The model gets back the friction and strength that it was bound with, so that an episode does
    not begin with those of the last step of the one before.

    Args:
      ctrl: what was commanded until now [U], which delays go on with; the first command if None.
    """
    if self.binding is not None:
      self.binding.last_force.fill(0.0)
      self.binding.clear()
      self._write(self.binding)
    for operator in self.operators:
      operator.reset()
    if ctrl is not None:
      for operator in self._commands:
        operator.command(0.0, np.array(ctrl, np.float64))

  def before_step(self, data: Any, ctrl: Array) -> None:
    """Writes command, forces and actuator strength for the coming physics step.

    Args:
      data: mujoco.MjData of the bound model.
      ctrl: what the controller commands now [U].
    """
    binding = self._bound()
    data = getattr(data, "ptr", data)
    applied = binding.ctrl
    applied[:] = ctrl
    for operator in self._commands:
      operator.command(data.time, applied)
    data.ctrl[:] = applied
    if self._lift is not None:
      data.qfrc_applied[:] = self._lift.torques(data)
    if not self._steps:
      return
    binding.data = data
    binding.note_last_force()
    binding.position[:] = data.qpos[binding.qpos]
    binding.velocity[:] = data.qvel[binding.dofs]
    binding.clear()
    for operator in self._steps:
      operator.step(binding)
    if self._adds_force:
      lifted = 0.0 if self._lift is None else data.qfrc_applied[binding.dofs]
      data.qfrc_applied[binding.dofs] = lifted + binding.force
    self._write(binding)

  def _write(self, binding: Binding) -> None:
    """Writes dry friction and actuator strength into the model."""
    if self._adds_friction:
      binding.write_friction()
    if self._scales:
      binding.write_actuators(shifted=self._shifts)

  def observe(self, channel: str, value: Array, time: float) -> Array:
    """Returns what is measured at `time` [s] when the truth is `value`.

    Args:
      channel: "joint_positions", "joint_velocities" ([J], order of the bound joints), "gyroscope",
        "accelerometer" ([3]) or "camera" (uint8 [H, W, C]). Others pass unchanged.
      value: the true (simulated) value now.
      time: s; must not decrease within an episode.
    """
    for operator in self._observers:
      value = operator.observe(channel, value, time)
    return value

  def stamp(self, time: float) -> float:
    """Returns the time stamp [s] that a measurement at `time` gets from its own clock."""
    for operator in self._stamps:
      time = operator.stamp(time)
    return time

  def _bound(self) -> Binding:
    if self.binding is None:
      raise ValueError("Found effects that are not in a model, expected stack.bind(model) first.")
    return self.binding
