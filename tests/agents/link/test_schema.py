"""Messages: round trips, and that nothing but the schema gets through."""

import json
import struct

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from nerf2real.agents.link import schema
from nerf2real.agents.link.schema import MessageError

GOOD = schema.encode("credit", {"n": 3, "who": "a"}, {"x": np.arange(6, dtype=np.float32)})


def test_round_trip_of_every_type():
  rng = np.random.default_rng(0)
  arrays = {
    name: rng.integers(0, 2, (2, 0, 3) if i == 0 else (2, 3)).astype(name)
    for i, name in enumerate(sorted(schema._DTYPES))
  }
  arrays["scalar"] = np.float32(2.5)
  arrays["strided"] = np.arange(12, dtype=np.int64).reshape(3, 4)[:, ::2]
  values = {"a": 1, "b": -0.25, "c": "text äö", "d": None, "e": [True, False]}
  message = schema.decode(schema.encode("anything", values, arrays), kind="anything")
  assert message.kind == "anything" and message.values == values
  for name, array in arrays.items():
    assert message.arrays[name].dtype == array.dtype
    np.testing.assert_array_equal(message.arrays[name], array)


@pytest.mark.parametrize(
  ("values", "arrays"),
  [
    ({"x": float("nan")}, {}),
    ({"x": object()}, {}),
    ({}, {"x": np.array(["text"])}),
    ({}, {"x": np.array([object()])}),
    ({}, {"x": np.zeros(2, np.complex64)}),
  ],
)
def test_what_cannot_be_held_is_refused_at_the_source(values, arrays):
  with pytest.raises(MessageError):
    schema.encode("k", values, arrays)


def _with_header(header: bytes, body: bytes = b"") -> bytes:
  return struct.pack("<4sHI", b"N2RL", 1, len(header)) + header + body


def _described(arrays) -> bytes:
  return json.dumps({"kind": "k", "values": {}, "arrays": arrays}).encode()


@pytest.mark.parametrize(
  "data",
  [
    b"",
    b"N2RL",
    b"XXXX" + GOOD[4:],
    GOOD[:4] + b"\x09\x00" + GOOD[6:],
    GOOD[:-1],
    GOOD + b"x",
    _with_header(b"not json"),
    _with_header(b"\xff\xfe"),
    _with_header(b"[]"),
    _with_header(b'{"kind": 1, "values": {}, "arrays": []}'),
    _with_header(b'{"kind": "k", "values": {}, "arrays": [], "more": 1}'),
    _with_header(b"[" * 100_000),
    _with_header(b'{"kind": "k", "values": {"n": ' + b"9" * 5000 + b'}, "arrays": []}'),
    _with_header(_described([["x", "object", [1]]]), b"12345678"),
    _with_header(_described([["x", "float32", [-1]]])),
    _with_header(_described([["x", "float32", [2**29, 2**29, 2**29]]])),
    _with_header(_described([["x", "float32", [1.0]]]), b"1234"),
    _with_header(_described([["x", "float32", [True]]]), b"1234"),
    _with_header(_described([["x", ["float32"], [1]]]), b"1234"),
    _with_header(_described([["x", "uint8", [1]], ["x", "uint8", [1]]]), b"12"),
    struct.pack("<4sHI", b"N2RL", 1, 2**31) + b"{}",
  ],
)
def test_malformed_messages_are_refused(data):
  with pytest.raises(MessageError):
    schema.decode(data)


@hypothesis.settings(max_examples=300, deadline=None)
@hypothesis.given(st.integers(0, len(GOOD) - 1), st.binary(min_size=1, max_size=4))
def test_damage_is_refused_or_harmless(at, noise):
  """Whatever bytes are changed: a message of the schema, or MessageError; never anything else."""
  damaged = GOOD[:at] + noise + GOOD[at + len(noise) :]
  try:
    message = schema.decode(damaged)
  except MessageError:
    return
  assert isinstance(message.kind, str) and isinstance(message.values, dict)


def test_values_are_checked():
  message = schema.decode(GOOD)
  assert schema.integer(message, "n") == 3 and schema.text(message, "who") == "a"
  with pytest.raises(MessageError, match="whole number"):
    schema.integer(message, "who")
  with pytest.raises(MessageError, match="whole number"):
    schema.integer(message, "n", high=2)
  with pytest.raises(MessageError, match="short string"):
    schema.text(message, "n")
  with pytest.raises(MessageError, match="Expected a message of kind"):
    schema.decode(GOOD, kind="grant")
