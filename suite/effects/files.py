"""effects.json: a list of {kind, target, parameters: {name: {value, low, high, unit, samples}}}."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nerf2real.core.files import write_atomically
from nerf2real.suite.effects.effect import Effect, Parameter, Value
from nerf2real.suite.effects.registry import kind_of


def check(effect: Effect) -> None:
  """Raises ValueError if an effect's kind, parameter names or values are not possible."""
  kind = kind_of(effect.kind)
  for name, value in effect.parameters.items():
    _check_value(kind.name, kind.parameter(name), value)
  for name in effect.intervals:
    kind.parameter(name)
  for name, values in effect.samples.items():
    for value in values:
      _check_value(kind.name, kind.parameter(name), value)


def count_samples(effects: Iterable[Effect]) -> int:
  """Returns how many joint draws effects hold, 0 for none.

  Raises:
    ValueError: two values have different numbers of draws.
  """
  lengths = {
    (effect.kind, effect.target, name): len(values)
    for effect in effects
    for name, values in effect.samples.items()
  }
  if len(set(lengths.values())) > 1:
    few, many = min(lengths, key=lengths.__getitem__), max(lengths, key=lengths.__getitem__)
    raise ValueError(
      f"Found {lengths[few]} samples of {few[2]!r} of the effect {few[0]!r} and {lengths[many]} of"
      f" {many[2]!r} of {many[0]!r}, expected as many of every value: the k-th of all are one draw."
    )
  return next(iter(lengths.values()), 0)


def _check_value(kind: str, parameter: Parameter, value: Any) -> None:
  numbers = value if parameter.is_list and isinstance(value, list | tuple) else [value]
  for number in numbers:
    if isinstance(number, bool) or not isinstance(number, int | float):
      raise ValueError(
        f"Found {value!r} for {parameter.name!r} of the effect {kind!r}, expected"
        f" {'a list of numbers' if parameter.is_list else 'a number'} in {parameter.unit}."
      )
    allowed = parameter.minimum <= number <= parameter.maximum
    if not (allowed and (math.isfinite(number) or number == parameter.nominal)):
      raise ValueError(
        f"Found {number} for {parameter.name!r} of the effect {kind!r}, expected a finite number"
        f" from {parameter.minimum} to {parameter.maximum} {parameter.unit}."
      )


def to_list(effects: Iterable[Effect]) -> list[dict[str, Any]]:
  """Returns the JSON form of effects. Infinite values, which mean no effect, are left out."""
  effects = list(effects)
  count_samples(effects)
  result = []
  for effect in effects:
    check(effect)
    kind = kind_of(effect.kind)
    parameters = {}
    for name, value in effect.parameters.items():
      if isinstance(value, float) and math.isinf(value):
        continue
      low, high = effect.intervals.get(name, (None, None))
      plain = list(value) if isinstance(value, Sequence) else value
      parameters[name] = {
        "value": plain,
        "low": low,
        "high": high,
        "unit": kind.parameter(name).unit,
      }
      if name in effect.samples:
        parameters[name]["samples"] = list(effect.samples[name])
    result.append({"kind": effect.kind, "target": effect.target, "parameters": parameters})
  return result


def from_list(items: Any) -> list[Effect]:
  """Returns the effects of a JSON form, checked.

  Raises:
    ValueError: naming the entry, what was found and what was expected.
  """
  if not isinstance(items, list):
    raise ValueError(f"Found {type(items).__name__} as effects, expected a list.")
  effects = []
  for index, item in enumerate(items):
    try:
      effects.append(_parse(item))
    except ValueError as error:
      raise ValueError(f"Effect {index}: {error}") from error
  count_samples(effects)
  return effects


def _parse(item: Any) -> Effect:
  if not isinstance(item, Mapping) or not {"kind"} <= set(item) <= {"kind", "target", "parameters"}:
    found = sorted(item) if isinstance(item, Mapping) else type(item).__name__
    raise ValueError(f"Found {found}, expected an object with kind, target and parameters.")
  kind = kind_of(item["kind"])
  target = item.get("target")
  if target is not None and not isinstance(target, str):
    raise ValueError(f"Found the target {target!r}, expected the name of a {kind.target} or null.")
  raw = item.get("parameters", {})
  if not isinstance(raw, Mapping):
    raise ValueError(f"Found {type(raw).__name__} as parameters, expected an object.")
  parameters: dict[str, Value] = {}
  intervals: dict[str, tuple[float, float]] = {}
  samples: dict[str, list[float]] = {}
  for name, entry in raw.items():
    parameter = kind.parameter(name)
    if not isinstance(entry, Mapping) or "value" not in entry:
      raise ValueError(
        f"Found {entry!r} for {name!r}, expected an object with value, low, high and unit."
      )
    unit = entry.get("unit", parameter.unit)
    if unit not in parameter.units():
      raise ValueError(
        f"Found the unit {unit!r} for {name!r} of {kind.name!r}, expected"
        f" {' or '.join(parameter.units())}."
      )
    parameters[name] = entry["value"]
    low, high = entry.get("low"), entry.get("high")
    for bound in (low, high):
      number = isinstance(bound, int | float) and not isinstance(bound, bool)
      if bound is not None and (not number or math.isnan(bound)):
        raise ValueError(
          f"Found the bound {bound!r} for {name!r} of {kind.name!r}, expected a number or null."
        )
    if low is not None and high is not None:
      intervals[name] = (low, high)
    if "samples" in entry:
      if not isinstance(entry["samples"], list) or not entry["samples"] or parameter.is_list:
        raise ValueError(
          f"Found {entry['samples']!r} as samples of {name!r} of {kind.name!r}, expected a list of"
          " numbers, one or more, of a value that is a number."
        )
      samples[name] = entry["samples"]
  effect = Effect(kind.name, target, parameters, intervals, samples)
  check(effect)
  return effect


def write_effects(path: str | Path, effects: Iterable[Effect]) -> None:
  """Writes effects.json."""
  write_atomically(path, json.dumps(to_list(effects), indent=2, allow_nan=False) + "\n")


def read_effects(path: str | Path) -> list[Effect]:
  """Reads effects.json; a missing or damaged file is one clear error."""
  path = Path(path)
  try:
    items = json.loads(path.read_text())
  except FileNotFoundError:
    raise FileNotFoundError(f"Found no file {path}, expected a list of effects there.") from None
  except (json.JSONDecodeError, UnicodeDecodeError) as error:
    raise ValueError(f"Found no valid JSON in {path}: {error}.") from error
  try:
    return from_list(items)
  except ValueError as error:
    raise ValueError(f"{path}: {error}") from error
