"""Serialization of dataclasses to plain JSON values and back, by cattrs.

Plain values are dictionaries, lists, strings, numbers, booleans and None. Dataclasses and named
tuples become dictionaries of their fields; tuples and arrays become lists; paths and enumerations
become their text or value. Loading follows the type annotations and is strict: a field that the
class lacks is an error, so that settings of another version are not read wrongly in silence.
"""

import dataclasses
import functools
import json
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cattrs
from cattrs.cols import is_namedtuple, namedtuple_dict_structure_factory

from nerf2real.core import files

if TYPE_CHECKING:  # commands read settings before they set the threads of NumPy's BLAS
  import numpy as np

T = TypeVar("T")


class SerializationError(ValueError):
  """Plain values do not fit a class; the message is one line that names every field at fault."""


def to_plain(value: Any) -> Any:
  """Returns the plain JSON values of dataclasses, named tuples, containers, arrays and paths."""
  if is_namedtuple(type(value)):
    value = value._asdict()
  elif dataclasses.is_dataclass(value) and not isinstance(value, type):
    value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
  if isinstance(value, Mapping):
    return {str(key): to_plain(item) for key, item in value.items()}
  if isinstance(value, list | tuple):
    return [to_plain(item) for item in value]
  if hasattr(value, "tolist"):  # NumPy's arrays and scalars
    return value.tolist()
  return _converter().unstructure(value)


def from_plain(values: Any, cls: type[T], *, source: str | Path = "") -> T:
  """Builds a `cls` from plain values; inverts `to_plain`.

  Arrays take the dtype of their annotation (`numpy.typing.NDArray[numpy.uint8]`), or else numpy's
  choice; an array of no rows loses its other dimensions.

  Args:
    values: What JSON holds.
    cls: A dataclass, or any type that is built of such.
    source: Named in errors, such as the file that was read; the class if empty.

  Raises:
    SerializationError: A field is unknown, missing or of another type.
  """
  try:
    return _converter().structure(values, cls)
  except Exception as error:  # cattrs passes on what constructors and hooks raise
    found = "; ".join(cattrs.transform_error(error, path="", format_exception=_reason))
    raise SerializationError(f"{source or cls.__name__}: {found}.") from error


def write_json(path: str | Path, value: Any, *, indent: int | None = 1) -> None:
  """Writes the plain values of `value` as JSON, atomically (`core.files`)."""
  files.write_atomically(path, json.dumps(to_plain(value), indent=indent))


def read_json(path: str | Path, cls: type[T]) -> T:
  """Reads what `write_json` wrote as a `cls`.

  Raises:
    FileNotFoundError: There is no such file.
    SerializationError: It is no JSON, or does not fit.
  """
  try:
    values = json.loads(Path(path).read_text(encoding="utf-8"))
  except (json.JSONDecodeError, UnicodeDecodeError) as error:
    raise SerializationError(f"{path} is no valid JSON: {error}.") from error
  return from_plain(values, cls, source=path)


@functools.cache
def _converter() -> cattrs.Converter:
  converter = cattrs.Converter(forbid_extra_keys=True)
  # cattrs would convert: bool("no") is True and int("3") is 3.
  for kind in (int, float, bool, str):
    converter.register_structure_hook(kind, _scalar)
  converter.register_structure_hook_func(_is_array, _array)
  converter.register_structure_hook_factory(is_namedtuple, namedtuple_dict_structure_factory)
  return converter


def _scalar(value: Any, kind: type) -> Any:
  if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
    return float(value)
  if kind is int and isinstance(value, float) and value.is_integer():
    return int(value)  # other programs write 3.0
  if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
    return value
  raise TypeError(f"expected {kind.__name__}, found {value!r}")


def _is_array(kind: Any) -> bool:
  kind = typing.get_origin(kind) or kind
  return (getattr(kind, "__module__", ""), getattr(kind, "__name__", "")) == ("numpy", "ndarray")


def _array(value: Any, kind: Any) -> "np.ndarray":
  import numpy as np

  parameters = typing.get_args(kind)  # (shape, numpy.dtype[kind of number])
  dtype = typing.get_args(parameters[1])[0] if parameters else None
  array = np.array(value, None if dtype is Any else dtype)
  if array.dtype == object:
    raise TypeError(f"expected an array, found {value!r}")
  return array


def _reason(error: BaseException, kind: type | None) -> str:
  if isinstance(error, cattrs.ForbiddenExtraKeysError):
    known = (field.name for field in dataclasses.fields(error.cl))
    unknown = ", ".join(sorted(map(repr, error.extra_fields)))
    return (
      f"unknown fields {unknown} (written by another version?), expected some of {', '.join(known)}"
    )
  if isinstance(error, KeyError):
    return f"the field {error} is missing"
  return str(error)
