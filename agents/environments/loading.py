"""Environments by name, with actions in [-1, 1]: anything that follows dm_env can be learned.

Names: `dm_control:cartpole:swingup`, `suite:nerf_nav`, `agents:cue`; options follow a question
mark: `suite:nerf_nav?image_size=60x80&scene=out/demo&pushes=false&camera_rate=15`. Options of
`suite:` environments:

- `scene`, `effects`: folder of a bundle, an effects.json; `draw_effects=true`: every episode draws
  the effects' values from their intervals;
- `image_size`: such as 30x40, height x width; `lens`: a camera_info YAML (a calibrated camera);
- `time_limit`, `physics_timestep` [s];
- every field of `RandomisationSettings`, such as `pushes=false` or `push_force=2,6`;
- every plain field of `CameraSettings` after `camera_`, such as `camera_rate=15` [Hz];
- `protocol`: navigation, gain or ball: episodes are the trials of that evaluation.
"""

import dataclasses
import urllib.parse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from nerf2real.agents.dmpo.specs import PRIVILEGED
from nerf2real.agents.environments.trials import Trials
from nerf2real.suite import protocols
from nerf2real.suite.tasks import catalogue


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
  from nerf2real.suite.randomisation.draws import RandomisationSettings

  protocol = options.pop("protocol", None)
  known = catalogue.PROTOCOLS.get(rest, ())
  if protocol is not None and protocol not in known:
    raise ValueError(
      f"suite:{rest} has no protocol {protocol!r}: expected one of {', '.join(known) or 'none'}."
    )
  arguments: dict[str, Any] = {}
  for key in ("scene", "effects"):
    if key in options:
      arguments[key] = options.pop(key)
  if "draw_effects" in options:
    arguments["draw_effects"] = _parse("draw_effects", options.pop("draw_effects"), False)
  for key in ("time_limit", "physics_timestep"):
    if key in options:
      arguments[key] = _parse(key, options.pop(key), 0.0)
  if "image_size" in options:
    text = options.pop("image_size")
    height, _, width = text.partition("x")
    if not (height.isdigit() and width.isdigit()):
      raise ValueError(f"image_size must be such as 30x40 (height x width), found {text!r}.")
    arguments["image_size"] = (int(height), int(width))
  camera = _take_camera(options)
  randomisation = _take(options, RandomisationSettings())
  environment = suite.load(
    rest, random=seed, camera=camera, randomisation=randomisation, **arguments
  )
  if protocol is None:
    return environment
  return Trials(environment, protocols.PROTOCOLS[protocol](), seed=seed)


def _take_camera(options: dict[str, str]) -> Any:
  """Takes the options of the camera; returns its `CameraSettings`."""
  from nerf2real.core.geometry.camera_info import read_camera_info
  from nerf2real.suite.sensors.camera import CameraSettings

  camera = _take(options, CameraSettings(), prefix="camera_")
  if "lens" in options:
    camera = dataclasses.replace(camera, lens=read_camera_info(Path(options.pop("lens"))))
  return camera


def camera_settings(name: str) -> Any:
  """Returns the `CameraSettings` of a suite's environment, such as of the one a policy trained on.

  Raises:
    ValueError: An option of the camera is wrong.
    OSError: The file of its lens cannot be read.
  """
  return _take_camera(dict(urllib.parse.parse_qsl(name.partition("?")[2])))


def _take(options: dict[str, str], settings: Any, *, prefix: str = "") -> Any:
  """Takes the options that name a field of settings; returns the settings with them."""
  changes = {}
  for field in dataclasses.fields(settings):
    default, name = getattr(settings, field.name), prefix + field.name
    if name in options and default is not None:
      changes[field.name] = _parse(name, options.pop(name), default)
  return dataclasses.replace(settings, **changes)


def _parse(name: str, text: str, like: Any) -> Any:
  """Reads an option's value of the type that its default has."""
  try:
    if isinstance(like, bool):
      return {"true": True, "false": False}[text]
    if isinstance(like, tuple):
      values = tuple(float(part) for part in text.split(","))
      if len(values) != len(like):
        raise ValueError
      return values
    return type(like)(text)
  except (KeyError, ValueError):
    kinds = {bool: "true or false", float: "a number", tuple: f"numbers such as {like}"}
    kind = kinds.get(type(like), "text")
    raise ValueError(f"{name} must be {kind}, found {text!r}.") from None


def evaluation_name(name: str) -> str:
  """The environment that a policy for `name` is evaluated on while it learns.

  For the suite's tasks: the protocol of the paper's table I, without pushes, as
  `launch/evaluate.py` runs it in simulation; scene, lens, effects and all else as in training. For
  other environments: the same.
  """
  family, _, task = name.partition("?")[0].partition(":")
  if family != "suite" or task not in catalogue.PROTOCOLS:
    return name
  protocol = {"protocol": catalogue.PROTOCOLS[task][0]}
  return with_options(name, {"pushes": "false"}, defaults=protocol)


def in_scene(name: str, scene: str | Path) -> str:
  """The name of a suite's environment that is the same in another scene bundle."""
  return with_options(name, {"scene": str(scene)})


def with_options(
  name: str, options: Mapping[str, str], *, defaults: Mapping[str, str] | None = None
) -> str:
  """The name of an environment with options changed, and others where it has none of its own."""
  path, _, query = name.partition("?")
  every = {**(defaults or {}), **dict(urllib.parse.parse_qsl(query)), **options}
  return f"{path}?{urllib.parse.urlencode(every, safe='/,')}"


def trials_of(environment: Any) -> Trials | None:
  """The protocol below the wrappers of an environment; None if its episodes are no trials."""
  while not isinstance(environment, Trials) and hasattr(environment, "_environment"):
    environment = environment._environment
  return environment if isinstance(environment, Trials) else None


def _agents(rest: str, options: dict[str, str], seed: int) -> dm_env.Environment:
  from nerf2real.agents.environments.cue_task import CueTask

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
