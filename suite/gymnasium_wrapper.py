"""Environments of the suite as Gymnasium environments; needs the extra `gymnasium`.

  environment = gymnasium.make("nerf2real/nerf_nav-v0", image_size=(30, 40))

or `GymnasiumEnv(suite.load(...))`. Observations are a `Dict` of the same names, without the
privileged ones unless they are asked for.
"""

from typing import Any

import dm_env
import gymnasium
import numpy as np
from dm_env import specs
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from nerf2real import suite
from nerf2real.suite.op3 import constants
from nerf2real.suite.tasks.privileged import PREFIX
from nerf2real.suite.views.third_person import ThirdPerson

_NAMESPACE = "nerf2real"
_HEIGHT, _WIDTH = 240, 320  # pixels of a rendered frame


def space_of(spec: specs.Array) -> spaces.Box:
  """Returns the space of a specification; without bounds it is that of all finite numbers."""
  low = np.broadcast_to(getattr(spec, "minimum", -np.inf), spec.shape)
  high = np.broadcast_to(getattr(spec, "maximum", np.inf), spec.shape)
  return spaces.Box(low.astype(spec.dtype), high.astype(spec.dtype), spec.shape, spec.dtype)


class GymnasiumEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
  """A dm_env environment of the suite behind Gymnasium's interface."""

  metadata = {  # noqa: RUF012  (Gymnasium's own attribute)
    "render_modes": ["rgb_array"],
    "render_fps": round(1 / constants.CONTROL_TIMESTEP),
  }

  def __init__(self, environment: Any, *, render_mode: str | None = None, privileged: bool = False):
    """Wraps an environment.

    Args:
      environment: From `suite.load`.
      render_mode: "rgb_array" for `render`, which shows a third person's view; None for none.
      privileged: Whether to give the observations that only a critic may see.

    Raises:
      ValueError: Another render mode.
    """
    if render_mode not in (None, *self.metadata["render_modes"]):
      raise ValueError(f"Unknown render_mode {render_mode!r}: expected 'rgb_array' or None.")
    self.environment, self.render_mode = environment, render_mode
    self._specs = {
      name: spec
      for name, spec in environment.observation_spec().items()
      if privileged or not name.startswith(PREFIX)
    }
    space: Any = spaces.Dict({n: space_of(s) for n, s in self._specs.items()})
    self.observation_space = space
    self.action_space = space_of(environment.action_spec())
    self._view: ThirdPerson | None = None
    self._begun = False  # whether there is an episode to see
    self._over = True  # whether it has ended, or none has begun
    self._closed = False

  def reset(
    self, *, seed: int | None = None, options: dict[str, Any] | None = None
  ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Starts an episode; the same seed gives the same episodes from then on."""
    super().reset(seed=seed)
    if seed is not None:
      self.environment.random_state.seed(seed)
    timestep = self.environment.reset()
    self._begun, self._over = True, False
    if self._view is not None:
      self._view.restart()
    return self._observe(timestep), {}

  def step(
    self, action: np.ndarray
  ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
    """Takes one control step.

    Returns:
      Observation; reward; terminated: the episode failed (a fall, a collision); truncated: the time
      limit; info with the reward's terms, `success` and, at the end, the `ending`.

    Raises:
      ResetNeeded: No episode has begun, or it has ended.
      ValueError: The action has another shape than its space or holds a NaN.
    """
    if self._over:
      raise ResetNeeded("Found a step outside of an episode: call reset() first, and at its end.")
    timestep = self.environment.step(action)
    task = self.environment.task
    terminated = timestep.last() and timestep.discount == 0.0
    info = {"reward_terms": dict(task.reward_terms), "success": bool(task.success)}
    if timestep.last():
      info["ending"] = task.outcome.ending or "time limit"
    truncated = timestep.last() and not terminated
    self._over = timestep.last()
    return self._observe(timestep), float(timestep.reward), terminated, truncated, info

  def render(self) -> np.ndarray | None:  # type: ignore[override]
    """Returns a third person's view, uint8 [240, 320, 3]; None without a render mode.

    Raises:
      ResetNeeded: No episode has begun.
      ValueError: The environment was loaded without pictures.
    """
    if self.render_mode is None:
      return None
    if not self._begun:
      raise ResetNeeded("Found no episode to render: call reset() first.")
    if self._view is None:
      environment = self.environment
      self._view = ThirdPerson(environment.task, environment.physics, height=_HEIGHT, width=_WIDTH)
    return self._view.draw()

  def close(self) -> None:
    """Frees the simulation; does nothing the second time."""
    if not self._closed:
      self._closed = True
      self.environment.close()

  def _observe(self, timestep: dm_env.TimeStep) -> dict[str, np.ndarray]:
    found = timestep.observation
    return {name: np.array(found[name], spec.dtype) for name, spec in self._specs.items()}


def make(
  *, task: str, render_mode: str | None = None, privileged: bool = False, **options: Any
) -> GymnasiumEnv:
  """Loads a task as a Gymnasium environment; the options are those of `suite.load`."""
  loaded = suite.load(task, privileged=privileged, **options)
  return GymnasiumEnv(loaded, render_mode=render_mode, privileged=privileged)


def register() -> None:
  """Registers all tasks with Gymnasium, as `nerf2real/<task>-v0`; safe to call twice."""
  for task in suite.known_tasks():
    name = f"{_NAMESPACE}/{task}-v0"
    if name not in gymnasium.registry:
      gymnasium.register(
        name, entry_point=f"{__name__}:make", kwargs={"task": task}, order_enforce=True
      )
