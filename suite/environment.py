"""A composer environment that compiles its model once and observes once a control step.

Composer's own reset recompiles the model (43 to 222 ms) and its observation updater visits every
observable at every physics step. Here randomisation writes to the compiled model, and the sensor
path of `suite.sensors.proprioception` keeps its own buffers: observables are read when a
control step ends.
"""

import collections
from collections.abc import Callable
from typing import Any

import dm_env
import mujoco
import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_control.rl import control
from dm_env import specs

from nerf2real.core import errors


class Reading(observable.Generic):
  """An observable that is read once a control step, with its specification given."""

  def __init__(self, read: Callable[[], np.ndarray], spec: specs.Array):
    """Creates the observable.

    Args:
      read: Returns the present value; the array must not be changed afterwards.
      spec: Shape, dtype and bounds.
    """
    super().__init__(lambda physics: read())
    self._spec = spec
    self.enabled = True

  @property
  def array_spec(self) -> specs.Array:
    return self._spec

  def read(self) -> np.ndarray:
    """Returns the present value."""
    return self._raw_callable(None)


class StepObserver:
  """Composer's observation updater, reduced to one reading a control step."""

  def __init__(self, task: Any):
    self._task = task
    self._readings: collections.OrderedDict[str, Reading] = collections.OrderedDict(
      (name, reading) for name, reading in task.observables.items() if reading.enabled
    )

  def reset(self, physics: Any, random_state: np.random.RandomState) -> None:
    """Starts the sensors for a new episode."""
    self._task.start_sensors(physics, random_state)

  def prepare_for_next_control_step(self) -> None:
    """Does nothing: there is no schedule."""

  def update(self) -> None:
    """Does nothing: readings are taken when the control step ends."""

  def get_observation(self) -> collections.OrderedDict[str, np.ndarray]:
    """Reads every enabled observable."""
    return collections.OrderedDict(
      (name, reading.read()) for name, reading in self._readings.items()
    )

  def observation_spec(self) -> collections.OrderedDict[str, specs.Array]:
    """Returns the specifications by name."""
    return collections.OrderedDict(
      (name, reading.array_spec.replace(name=name)) for name, reading in self._readings.items()
    )


class Physics(mjcf.Physics):
  """MuJoCo's model and state, with an error in one line where nothing can be drawn."""

  def _make_rendering_contexts(self) -> None:
    """Creates the OpenGL context of `render`.

    Raises:
      RuntimeError: There is no OpenGL.
    """
    try:
      super()._make_rendering_contexts()
    except Exception as error:  # each backend fails in its own way
      raise RuntimeError(errors.no_opengl(error)) from error


class Environment(composer.Environment):
  """A task in its scene; see `suite.load`."""

  def __init__(self, task: Any, *, time_limit: float, random_state: Any = None):
    """Compiles the task's model.

    Args:
      task: A `suite.tasks.base.RobotTask`.
      time_limit: Length of an episode [s].
      random_state: A seed or `np.random.RandomState`.
    """
    super().__init__(
      task,
      # Time is a sum of steps: half a step less makes the number of steps exact.
      time_limit=time_limit - task.physics_timestep / 2,
      random_state=random_state,
      recompile_mjcf_every_episode=False,
    )
    self._mjcf_never_compiled = False  # the constructor has compiled it
    self._action_spec = task.action_spec(self.physics)

  def _recompile_physics(self) -> None:
    before = getattr(self, "_physics", None)
    if before is not None:
      before.free()
    self._physics: Any = Physics.from_mjcf_model(self._task.root_entity.mjcf_model)
    self._physics.legacy_step = self._legacy_step

  def _make_observation_updater(self) -> StepObserver:
    return StepObserver(self._task)

  def action_spec(self) -> specs.BoundedArray:
    """Returns the specification of an action."""
    return self._action_spec

  def step(self, action: Any) -> dm_env.TimeStep:
    """Takes one control step.

    Raises:
      ValueError: The action has another shape than the specification or holds a NaN.
    """
    action = np.asarray(action)
    if action.shape != self._action_spec.shape or not np.isfinite(action).all():
      raise ValueError(errors.bad_action(action, self._action_spec))
    return super().step(action)

  def _substep(self, action: np.ndarray) -> None:
    physics = self._physics
    self._hooks.before_substep(self._physics_proxy, action, self._random_state)
    # As dm_control's legacy step: positions and velocities are up to date when it ends.
    mujoco.mj_step2(physics.model.ptr, physics.data.ptr)
    mujoco.mj_step1(physics.model.ptr, physics.data.ptr)
    self._hooks.after_substep(self._physics_proxy, self._random_state)
    self._check_physics()

  def _check_physics(self) -> None:
    # Counts start at zero in every episode, so any count is a new warning.
    counts = self._physics.data.ptr.warning.number
    if counts.any():
      names = [
        name for name, count in zip(mujoco.mjtWarning.__members__, counts, strict=False) if count
      ]
      raise control.PhysicsError(f"MuJoCo reports {', '.join(names)}: the simulation is invalid.")
