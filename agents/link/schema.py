"""Messages on the wire: a small typed header in JSON, then raw arrays. No pickle.

    "N2RL" | version u16 | header length u32 | header (JSON, UTF-8) | array bytes, one after another

All numbers are little-endian. The header is {"kind": str, "values": {...}, "arrays": [[name, dtype,
shape], ...]}; values are numbers, strings, booleans, null, and lists of those. Anything that does
not fit exactly is refused with `MessageError`; nothing in a message is ever executed.
"""

import json
import math
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

_MAGIC = b"N2RL"
_VERSION = 1
_PREFIX = struct.Struct("<4sHI")
_MAX_HEADER = 1 << 20  # bytes; a policy's header takes some 5 KB
_MAX_ARRAYS = 1024
_MAX_MESSAGE = 1 << 30  # bytes
_MAX_AXES = 8
_DTYPES = frozenset(
  ("float32", "float64", "float16", "uint8", "int8", "uint32", "int32", "int64", "uint64", "bool")
)


class MessageError(ValueError):
  """A message does not follow the schema."""


class Message(NamedTuple):
  """A decoded message; the arrays are read-only views of its bytes."""

  kind: str
  values: dict[str, Any]
  arrays: dict[str, np.ndarray]


def encode(
  kind: str, values: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
) -> bytes:
  """Turns a message into bytes; raises MessageError for what the schema cannot hold."""
  descriptions, parts = [], []
  for name, given in (arrays or {}).items():
    array = np.asarray(given, order="C")
    if array.dtype.name not in _DTYPES or array.ndim > _MAX_AXES:
      raise MessageError(f"{name}: arrays of {array.dtype} with {array.ndim} axes cannot be sent.")
    descriptions.append([name, array.dtype.name, list(array.shape)])
    parts.append(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
  try:
    header = json.dumps(
      {"kind": kind, "values": dict(values), "arrays": descriptions}, allow_nan=False
    ).encode()
  except (TypeError, ValueError) as error:
    raise MessageError(f"The values of {kind!r} cannot be sent: {error}.") from error
  if len(header) > _MAX_HEADER:
    raise MessageError(f"The header of {kind!r} takes {len(header)} bytes, at most {_MAX_HEADER}.")
  return b"".join([_PREFIX.pack(_MAGIC, _VERSION, len(header)), header, *parts])


def decode(data: bytes, *, kind: str | None = None) -> Message:
  """Reads a message, and checks that it is of a kind if one is given.

  Raises:
    MessageError: with what was found and what was expected.
  """
  if len(data) < _PREFIX.size or len(data) > _MAX_MESSAGE:
    raise MessageError(f"Found a message of {len(data)} bytes: too short or too long.")
  magic, version, header_size = _PREFIX.unpack_from(data)
  if magic != _MAGIC or version != _VERSION:
    raise MessageError(
      f"Expected a message {_MAGIC!r} of version {_VERSION}, found {magic!r} of {version}: are all "
      "processes of the same release?"
    )
  begin = _PREFIX.size + header_size
  if header_size > _MAX_HEADER or begin > len(data):
    raise MessageError(f"The header claims {header_size} bytes; the message has {len(data)}.")
  header = _header(data[_PREFIX.size : begin])
  if kind is not None and header["kind"] != kind:
    raise MessageError(f"Expected a message of kind {kind!r}, found {header['kind']!r}.")
  arrays: dict[str, np.ndarray] = {}
  for name, dtype, shape in header["arrays"]:
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if begin + size > len(data):
      raise MessageError(f"{name} {dtype} {shape} reaches beyond the message's end.")
    if name in arrays:
      raise MessageError(f"{name} occurs twice.")
    flat = np.frombuffer(data, np.dtype(dtype).newbyteorder("<"), math.prod(shape), begin)
    arrays[name] = flat.reshape(shape)
    begin += size
  if begin != len(data):
    raise MessageError(f"{len(data) - begin} bytes follow the last array.")
  return Message(header["kind"], header["values"], arrays)


def _header(data: bytes) -> dict[str, Any]:
  try:
    header = json.loads(data.decode())
  except (ValueError, RecursionError) as error:  # ValueError: an integer too long, too
    raise MessageError(f"The header is not JSON: {error}.") from error
  if not isinstance(header, dict) or set(header) != {"kind", "values", "arrays"}:
    raise MessageError("The header must have kind, values and arrays.")
  if not isinstance(header["kind"], str) or not isinstance(header["values"], dict):
    raise MessageError("kind must be a string and values an object.")
  arrays = header["arrays"]
  if not isinstance(arrays, list) or len(arrays) > _MAX_ARRAYS:
    raise MessageError(f"arrays must be a list of at most {_MAX_ARRAYS}.")
  for entry in arrays:
    if not (isinstance(entry, list) and len(entry) == 3):
      raise MessageError("Every array is described as [name, dtype, shape].")
    name, dtype, shape = entry
    if not isinstance(name, str) or not isinstance(dtype, str) or dtype not in _DTYPES:
      raise MessageError(f"Found an array {name!r} of type {dtype!r}: not one that can be sent.")
    whole = isinstance(shape, list) and len(shape) <= _MAX_AXES
    if not whole or not all(type(n) is int and 0 <= n < _MAX_MESSAGE for n in shape):
      raise MessageError(f"{name} has the shape {shape!r}.")
  return header


def integer(message: Message, name: str, *, low: int = 0, high: int = 2**63 - 1) -> int:
  """Reads a whole number from a message's values; raises MessageError if it is none."""
  value = message.values.get(name)
  if type(value) is not int or not low <= value <= high:
    raise MessageError(f"{message.kind}: {name} must be a whole number, found {value!r}.")
  return value


def text(message: Message, name: str, *, longest: int = 200) -> str:
  """Reads a string from a message's values; raises MessageError if it is none."""
  value = message.values.get(name)
  if not isinstance(value, str) or not 0 < len(value) <= longest:
    raise MessageError(f"{message.kind}: {name} must be a short string, found {value!r:.60}.")
  return value
