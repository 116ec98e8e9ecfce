"""Environments by name, with actions in [-1, 1]: anything that follows dm_env can be learned.

Names: `dm_control:cartpole:swingup`, `suite:nerf_nav`, `agents:cue`; options follow a question
mark: `suite:nerf_nav?image_size=60x80&scene=out/demo&effects=effects.json`.
"""

import urllib.parse
from collections.abc import Callable, Mapping
from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from nerf2real.agents.dmpo.specs import PRIVILEGED


def make_environment(name: str, *, seed: int, history: int = 1) -> dm_env.Environment:
  """Builds an environment.

  Args:
    name: see the module's docstring.
    seed: the same seed gives the same episodes.
    history: observations stacked, newest last, where the environment does not stack them itself;
      pictures and privileged observations are not stacked.

  Raises:
    ValueError: for a name or option that is not known.
  """
  path, _, query = name.partition("?")
  family, _, rest = path.partition(":")
  if family not in _FAMILIES:
    raise ValueError(
      f"Unknown environment {name!r}: expected one of {', '.join(f + ':...' for f in _FAMILIES)}."
    )
  options = dict(urllib.parse.parse_qsl(query, strict_parsing=True)) if query else {}
  environment = Canonical(_FAMILIES[family](rest, options, seed))
  if options:
    raise ValueError(f"Unknown options {sorted(options)} of environment {name!r}.")
  return Stacked(environment, history) if history > 1 else environment


def _dm_control(rest: str, options: dict[str, str], seed: int) -> dm_env.Environment:
  from dm_control import suite as control_suite

  domain, _, task = rest.partition(":")
  if (domain, task) not in control_suite.ALL_TASKS:
    raise ValueError(f"dm_control has no task {rest!r}: expected such as 'cartpole:swingup'.")
  return control_suite.load(domain, task, task_kwargs={"random": seed})


def _suite(rest: str, options: dict[str, str], seed: int) -> dm_env.Environment:
  from nerf2real import suite

  arguments: dict[str, Any] = {}
  for key in ("scene", "effects"):
    if key in options:
      arguments[key] = options.pop(key)
  if "time_limit" in options:
    arguments["time_limit"] = float(options.pop("time_limit"))
  if "image_size" in options:
    text = options.pop("image_size")
    height, _, width = text.partition("x")
    if not (height.isdigit() and width.isdigit()):
      raise ValueError(f"image_size must be such as 30x40 (height x width), found {text!r}.")
    arguments["image_size"] = (int(height), int(width))
  return suite.load(rest, random=seed, **arguments)


def _agents(rest: str, options: dict[str, str], seed: int) -> dm_env.Environment:
  from nerf2real.agents.processes.cue_task import CueTask

  if rest != "cue":
    raise ValueError(f"agents has no task {rest!r}: expected 'cue'.")
  return CueTask(seed=seed)


_FAMILIES: dict[str, Callable[[str, dict[str, str], int], dm_env.Environment]] = {
  "dm_control": _dm_control,
  "suite": _suite,
  "agents": _agents,
}


class Canonical(dm_env.Environment):
  """Maps actions from [-1, 1] to the wrapped environment's bounds, clipping what is outside."""

  def __init__(self, environment: dm_env.Environment):
    self._environment = environment
    spec = environment.action_spec()
    if not isinstance(spec, specs.BoundedArray) or not (
      np.isfinite(spec.minimum).all() and np.isfinite(spec.maximum).all()
    ):
      raise ValueError(f"Expected actions with finite bounds, found {spec}.")
    self._spec = spec
    self._low = np.broadcast_to(spec.minimum, spec.shape)
    self._range = np.broadcast_to(spec.maximum, spec.shape) - self._low

  def reset(self) -> dm_env.TimeStep:
    return self._environment.reset()

  def step(self, action: np.ndarray) -> dm_env.TimeStep:
    clipped = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
    scaled = self._low + 0.5 * (clipped + 1.0) * self._range
    return self._environment.step(scaled.astype(self._spec.dtype))

  def observation_spec(self) -> Any:
    return self._environment.observation_spec()

  def action_spec(self) -> specs.BoundedArray:
    shape = self._spec.shape
    return specs.BoundedArray(shape, np.float32, -np.ones(shape), np.ones(shape), "action")

  def close(self) -> None:
    self._environment.close()


class Stacked(dm_env.Environment):
  """Gives every vector observation as its last `history` values; the first one fills the past."""

  def __init__(self, environment: dm_env.Environment, history: int):
    self._environment = environment
    self._history = history
    self._past: dict[str, np.ndarray] = {}

  def _stacks(self, name: str, array: Any) -> bool:
    return array.dtype != np.uint8 and not name.startswith(PRIVILEGED)

  def _stack(self, timestep: dm_env.TimeStep) -> dm_env.TimeStep:
    observation: Mapping[str, Any] = timestep.observation
    stacked = dict(observation)
    for name, value in observation.items():
      array = np.asarray(value)
      if not self._stacks(name, array):
        continue
      if timestep.first():
        self._past[name] = np.repeat(array[None], self._history, axis=0)
      else:
        self._past[name] = np.concatenate([self._past[name][1:], array[None]])
      stacked[name] = self._past[name]
    return timestep._replace(observation=stacked)

  def reset(self) -> dm_env.TimeStep:
    return self._stack(self._environment.reset())

  def step(self, action: np.ndarray) -> dm_env.TimeStep:
    return self._stack(self._environment.step(action))

  def observation_spec(self) -> dict[str, specs.Array]:
    result = dict(self._environment.observation_spec())
    for name, spec in result.items():
      if self._stacks(name, spec):
        result[name] = specs.Array((self._history, *spec.shape), spec.dtype, name)
    return result

  def action_spec(self) -> specs.BoundedArray:
    return self._environment.action_spec()

  def close(self) -> None:
    self._environment.close()
