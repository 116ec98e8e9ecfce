"""What an effect is: a kind, a target and parameters; and the operator that carries it out.

An `Effect` is data: it can be written to and read from effects.json, fitted, compared. An
`Operator` does the work for all effects of one kind at once, vectorised over joints or actuators.
Kinds declare their parameters, so that other code (system identification) can iterate over them.

Shapes: J joints of the binding, U actuators of the model.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import numpy as np

from nerf2real.suite.effects.binding import Binding

Array = np.ndarray
Value = float | Sequence[float]

# Units of a hinge joint's quantities, and of a slide joint's.
SLIDE_UNITS = {
  "rad": "m",
  "rad/s": "m/s",
  "N m": "N",
  "N m/rad": "N/m",
  "N m s/rad": "N s/m",
  "N m s^2/rad^2": "N s^2/m^2",
  "1/(N m)": "1/N",
  "K/(s N^2 m^2)": "K/(s N^2)",
  "kg m^2": "kg",
  "1/rad": "1/m",
}


@dataclasses.dataclass(frozen=True)
class Parameter:
  """One number of a kind of effect."""

  name: str
  unit: str
  """SI, of a hinge joint where it concerns joints (`of_joint`); see SLIDE_UNITS."""
  nominal: float
  """The value at which the kind does nothing (for shape parameters: a usual value)."""
  low: float
  """Lower end of the plausible range: where a search may start."""
  high: float
  """Upper end of the plausible range."""
  doc: str
  minimum: float = -math.inf
  """Hard limit: smaller values are an error."""
  maximum: float = math.inf
  """Hard limit: larger values are an error."""
  shape: bool = False
  """A shape parameter: alone it does not turn the effect on or off."""
  is_list: bool = False
  """The value is a list of numbers."""
  fitted: bool = True
  """False for a choice between models (0 or 1) or a grid's bounds, which a fit keeps fixed."""
  of_joint: bool = True
  """False for what the world or a sensor turns by, whose unit is the same beside a slide."""

  def units(self) -> tuple[str, ...]:
    """Returns the units that a file may state: of a hinge joint and, if another, of a slide."""
    slide = SLIDE_UNITS.get(self.unit) if self.of_joint else None
    return (self.unit,) if slide is None else (self.unit, slide)


@dataclasses.dataclass(frozen=True)
class Kind:
  """A kind of effect: what it is called, what it acts on, which numbers it has."""

  name: str
  summary: str
  target: str
  """What `Effect.target` names: "joint", "body", "geom" or "none". None as a target means all."""
  acts: str
  """Where it acts: "model" (constants only, so that a plain MuJoCo model can express it),
  "command", "force", "actuator" or "measurement"."""
  parameters: tuple[Parameter, ...]
  operator: "type[Operator]"
  law: Callable | None = None
  """A force of (position, velocity, *parameters), of a kind that is nothing else; `force_law`."""

  def nominal(self) -> dict[str, Value]:
    """Returns parameters with which the kind does nothing."""
    return {p.name: [] if p.is_list else p.nominal for p in self.parameters}

  def parameter(self, name: str) -> Parameter:
    """Returns the parameter of that name."""
    for parameter in self.parameters:
      if parameter.name == name:
        return parameter
    raise ValueError(
      f"Found the parameter {name!r} of the effect {self.name!r}, expected one of"
      f" {[p.name for p in self.parameters]}."
    )


@dataclasses.dataclass(frozen=True)
class Effect:
  """One effect of a robot or its surroundings that the nominal model lacks."""

  kind: str
  target: str | None = None
  """Name of the joint (or actuator), body or geom; None for all, or where there is no choice."""
  parameters: Mapping[str, Value] = dataclasses.field(default_factory=dict)
  """Values in the units of the kind; those left out are nominal."""
  intervals: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
  """Lower and upper bound of a parameter's value, where known."""
  samples: Mapping[str, Sequence[float]] = dataclasses.field(default_factory=dict)
  """Values of joint draws: the k-th of all values of all effects belong together."""

  def replace(self, **parameters: Value) -> "Effect":
    """Returns a copy with some parameter values changed."""
    return dataclasses.replace(self, parameters={**self.parameters, **parameters})


class Operator:
  """Carries out all effects of one kind. Subclasses override `bind` and the hooks they need.

  Hooks at the physics rate: `command` (what reaches the actuators), `step` (force, friction and
  actuator strength, written to the binding's arrays). Hooks at the sensor's rate: `observe`,
  `stamp`. A hook that is not overridden costs nothing.
  """

  kind: ClassVar[Kind]

  def __init__(self, effects: Sequence[Effect]):
    self.effects = list(effects)

  def bind(self, binding: Binding) -> None:
    """Resolves names and writes what is constant into the binding's model."""
    raise NotImplementedError

  def reset(self) -> None:
    """Starts an episode: clears state."""

  def command(self, time: float, ctrl: Array) -> None:
    """Changes the command [U] in place."""

  def step(self, binding: Binding) -> None:
    """Adds to the binding's `force`, `friction`, `encoder_shift` [J]; scales `strength` [U]."""

  def observe(self, channel: str, value: Array, time: float) -> Array:
    """Returns what is measured instead of `value`."""
    return value

  def stamp(self, time: float) -> float:
    """Returns the time stamp that a measurement taken at `time` [s] gets."""
    return time

  def overrides(self, hook: str) -> bool:
    """Returns whether this operator has its own version of a hook."""
    return getattr(type(self), hook) is not getattr(Operator, hook)

  def value(self, effect: Effect, name: str) -> float:
    """Returns a parameter of an effect, nominal if left out."""
    return float(effect.parameters.get(name, self.kind.parameter(name).nominal))  # type: ignore

  def per_joint(self, binding: Binding) -> dict[str, Array]:
    """Returns each scalar parameter as an array [J], nominal where no effect names the joint."""
    return self._spread(len(binding.joints), binding.joint_index, "joint")

  def per_actuator(self, binding: Binding) -> dict[str, Array]:
    """Returns each scalar parameter as an array [U], nominal where no effect names the actuator."""
    return self._spread(binding.model.nu, binding.actuator_indices, "actuator")

  def _spread(self, count: int, find, noun: str) -> dict[str, Array]:
    scalars = [p for p in self.kind.parameters if not p.is_list]
    arrays = {p.name: np.full(count, p.nominal) for p in scalars}
    taken: set[int] = set()
    # Effects on all come first, so that one on a named joint replaces them there.
    for effect in sorted(self.effects, key=lambda e: e.target is not None):
      index = find(effect.target)
      chosen = {int(i) for i in np.arange(count)[index].reshape(-1)}
      if effect.target is not None and chosen & taken:
        raise ValueError(
          f"Found two effects of kind {self.kind.name!r} for the {noun} {effect.target!r}, expected"
          " one: add their parameters up."
        )
      taken |= chosen if effect.target is not None else set()
      for p in scalars:
        arrays[p.name][index] = self.value(effect, p.name)
    return arrays
