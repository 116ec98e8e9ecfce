"""Undeclared effects of a virtual robot by name, such as `command_delay:0.045`: parsed, put in.

A text is `KIND[@TARGET][:NUMBER,NUMBER,...]`. Kinds that `suite.effects` has, too, carry its names,
its units and its meaning; the others are outside that library. CASES are sets of them by name.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.core import errors
from nerf2real.real.virtual.camera import VirtualCamera
from nerf2real.real.virtual.hidden import Hidden, Load
from nerf2real.suite.op3 import constants


class Build(NamedTuple):
  """What a virtual robot is built from."""

  hidden: Hidden
  camera: VirtualCamera


@dataclasses.dataclass(frozen=True)
class Undeclared:
  """An effect of a virtual robot that its declared model lacks."""

  kind: str
  target: str | None
  values: tuple[float, ...]

  def __str__(self) -> str:
    """Returns the text that `parse` reads."""
    target = "" if self.target is None else f"@{self.target}"
    return f"{self.kind}{target}:{','.join(f'{value:.4g}' for value in self.values)}"

  @property
  def parameters(self) -> dict[str, float]:
    """Values by the kind's names."""
    return dict(zip(KINDS[self.kind].parameters, self.values, strict=True))

  def scaled(self, factor: float) -> "Undeclared":
    """Returns the effect with its size, the first value's distance from none, times a factor."""
    kind = KINDS[self.kind]
    sizes = [
      kind.none + factor * (value - kind.none) if index in kind.sizes else value
      for index, value in enumerate(self.values)
    ]
    return dataclasses.replace(self, values=tuple(sizes))


class Kind(NamedTuple):
  """A kind of undeclared effect."""

  parameters: tuple[str, ...]
  put: Callable[[Build, str | None, tuple[float, ...]], Build]
  targets: tuple[str, ...] = ()  # names that it takes; none: it is of the whole robot
  defaults: tuple[float, ...] = ()  # of the last parameters
  none: float = 0.0  # value of a size at which there is no effect
  sizes: tuple[int, ...] = (0,)  # which parameters are sizes
  signed: bool = False  # whether sizes may be negative
  in_library: bool = True  # whether `suite.effects` has it, by this name


def _motors(build: Build, **changes: object) -> Build:
  motors = dataclasses.replace(build.hidden.motors, **changes)  # type: ignore[arg-type]
  return build._replace(hidden=dataclasses.replace(build.hidden, motors=motors))


def _command_delay(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  return _motors(build, goal_delay=build.hidden.motors.goal_delay + values[0])


def _camera_latency(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  latency = build.camera.undeclared_latency + values[0]
  return build._replace(camera=dataclasses.replace(build.camera, undeclared_latency=latency))


def _camera_focal(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  lens = build.camera.lens
  longer = dataclasses.replace(lens, fx=values[0] * lens.fx, fy=values[0] * lens.fy)
  return build._replace(camera=dataclasses.replace(build.camera, lens=longer))


def _motor_gain(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  strength = build.hidden.motors.strength.copy()
  strength[[target in (None, name) for name in constants.JOINT_NAMES]] *= values[0]
  return _motors(build, strength=strength)


def _load_friction(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  share = build.hidden.motors.gear_share.copy()
  share[[target in (None, name) for name in constants.JOINT_NAMES]] += values[0]
  return _motors(build, gear_share=share)


def _floor_friction(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  friction = values[0] * build.hidden.foot_friction
  return build._replace(hidden=dataclasses.replace(build.hidden, foot_friction=friction))


def _payload(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  mass, x, y, z = values
  loads = (*build.hidden.loads, Load(str(target), mass, (x, y, z)))
  return build._replace(hidden=dataclasses.replace(build.hidden, loads=loads))


def _floor_slope(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  return build._replace(
    hidden=dataclasses.replace(build.hidden, floor_slope=(values[0], values[1]))
  )


def _supply_course(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  fall, full, seconds = values
  return _motors(build, battery_course=((0.0, full), (seconds, full - fall)))


def _rest_friction(build: Build, target: str | None, values: tuple[float, ...]) -> Build:
  return _motors(build, rest_friction=values[0], rest_time=values[1])


_SESSION = 600.0  # s, of 30 trials of navigation: 603 s measured where nothing is hidden
_LINKS = tuple(link.name for link in constants.read_links())
KINDS: Mapping[str, Kind] = {
  "command_delay": Kind(("delay",), _command_delay),  # s
  "camera_latency": Kind(("delay",), _camera_latency),  # s
  "camera_focal": Kind(("scale",), _camera_focal, none=1.0),
  "motor_gain": Kind(("gain",), _motor_gain, targets=constants.JOINT_NAMES, none=1.0),
  # Of the torque that the motor gives, besides what its gear takes anyway.
  "load_friction": Kind(("coefficient",), _load_friction, targets=constants.JOINT_NAMES),
  "floor_friction": Kind(("scale",), _floor_friction, none=1.0),
  "payload": Kind(  # kg, m in the link
    ("mass", "x", "y", "z"), _payload, targets=_LINKS, defaults=(0.0, 0.0, 0.0)
  ),
  # rad about the world's axes
  "floor_slope": Kind(("x", "y"), _floor_slope, sizes=(0, 1), signed=True),
  # V, V, s: the battery's voltage falls by so much from its first value within so long.
  "supply_course": Kind(
    ("fall", "full", "seconds"), _supply_course, defaults=(12.5, _SESSION), in_library=False
  ),
  # N m, s: dry friction that a joint gains while it rests, and how fast.
  "rest_friction": Kind(("torque", "time"), _rest_friction, defaults=(0.3,), in_library=False),
}

_SLOPE = float(np.deg2rad(2.5))
CASES: Mapping[str, tuple[str, ...]] = {
  "nothing": (),
  "late_commands": ("command_delay:0.045",),
  "other_camera": ("camera_latency:0.12", "camera_focal:1.12"),
  "weak_knee": ("motor_gain@l_knee:0.6",),
  "load_and_slope": ("payload@l_el_link:0.25,0,0.07,0", f"floor_slope:0,{_SLOPE:.4f}"),
  "sagging_supply": (f"supply_course:2.3,12.5,{_SESSION:g}",),
  "rest_friction": ("rest_friction:0.3,0.3",),
}
"""Effects by the name of a case."""


def parse(text: str) -> list[Undeclared]:
  """Reads an effect, the name of a case, or a file with one of either a line (# begins a comment).

  Raises:
    ValueError: It is none of them; the line says what was found and what is expected.
  """
  text = text.strip()
  if text in CASES:
    return [effect for item in CASES[text] for effect in parse(item)]
  if Path(text).suffix and Path(text).is_file():
    lines = (line.partition("#")[0].strip() for line in Path(text).read_text().splitlines())
    return [effect for line in lines if line for effect in parse(line)]
  name, _, numbers = text.partition(":")
  kind, _, target = name.partition("@")
  if kind not in KINDS:
    known = [*dict.fromkeys((*CASES, *KINDS))]
    raise ValueError(errors.unknown_name("undeclared effect", kind, known))
  return [Undeclared(kind, _target(kind, target or None), _values(kind, numbers))]


def _target(kind: str, target: str | None) -> str | None:
  known = KINDS[kind].targets
  if (target is None and kind == "payload") or (target is not None and target not in known):
    expected = f"one of {', '.join(known)}" if known else f"no target: {kind}:..."
    raise ValueError(f"Found the target {target!r} of {kind}, expected {expected}.")
  return target


def _values(kind: str, numbers: str) -> tuple[float, ...]:
  wanted, defaults = KINDS[kind].parameters, KINDS[kind].defaults
  try:
    found = tuple(float(number) for number in numbers.split(",") if number)
  except ValueError:
    found = ()
  missing = len(wanted) - len(found)
  if not found or not 0 <= missing <= len(defaults):
    raise ValueError(f"Found {numbers!r} for {kind}, expected the numbers {', '.join(wanted)}.")
  values = (*found, *defaults[len(defaults) - missing :]) if missing else found
  for index, (name, value) in enumerate(zip(wanted, values, strict=True)):
    negative = value < 0 and index in KINDS[kind].sizes and not KINDS[kind].signed
    if negative or not math.isfinite(value):
      expected = "a finite number" if not negative else "0 or more"
      raise ValueError(f"Found {value:g} for {name} of {kind}, expected {expected}.")
  return values


def parse_all(texts: Iterable[str]) -> tuple[Undeclared, ...]:
  """Reads several texts; see `parse`."""
  return tuple(effect for text in texts for effect in parse(text))


def put_in(made: Build, effects: Iterable[Undeclared]) -> Build:
  """Returns a robot and its camera with undeclared effects put in."""
  for effect in effects:
    made = KINDS[effect.kind].put(made, effect.target, effect.values)
  return made


def build(seed: int | None, effects: Iterable[Undeclared] = (), *, age: float = 0.0) -> Build:
  """Returns what a virtual robot with undeclared effects is built from.

  Args:
    seed: Of the robot's own build; None: as in the data sheets.
    effects: What it has besides.
    age: Time that its battery was in use before [s].
  """
  hidden = Hidden.none() if seed is None else Hidden.draw(seed)
  motors = dataclasses.replace(hidden.motors, battery_age=age)
  made = Build(dataclasses.replace(hidden, motors=motors), VirtualCamera())
  return put_in(made, effects)


def draw(seed: int) -> tuple[Undeclared, ...]:
  """Draws one of the CASES, with its sizes times 0.7 to 1.2 (chosen: they stay plausible)."""
  rng = np.random.default_rng([seed, 16])
  names = [name for name in CASES if name != "nothing"]
  name = names[int(rng.integers(len(names)))]
  return tuple(effect.scaled(float(rng.uniform(0.7, 1.2))) for effect in parse(name))
