"""Dataclasses become JSON and come back equal; what does not fit is refused by name."""

import dataclasses
import enum
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from nerf2real.core.serialization import (
  SerializationError,
  from_plain,
  read_json,
  to_plain,
  write_json,
)


class Colour(enum.Enum):
  RED = "red"


class Range(NamedTuple):
  low: float
  high: float = 1.0


@dataclasses.dataclass(frozen=True)
class Part:
  name: str
  sizes: tuple[int, ...] = ()
  pair: tuple[float, float] | None = None
  colour: Colour = Colour.RED
  range: Range = Range(0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Whole:
  part: Part
  parts: list[Part] = dataclasses.field(default_factory=list)
  values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  path: Path | None = None
  on: bool = False
  rate: float = 0.5
  count: int = 0


@dataclasses.dataclass(frozen=True)
class Arrays:
  matrix: np.ndarray
  pixels: NDArray[np.uint8]
  missing: np.ndarray | None = None


numbers = st.floats(allow_nan=False)
parts = st.builds(Part, range=st.builds(Range, numbers, numbers))
plain = st.recursive(
  st.none() | st.booleans() | st.integers() | numbers | st.text(),
  lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)
wholes = st.builds(
  Whole,
  part=parts,
  parts=st.lists(parts, max_size=2),
  values=st.dictionaries(st.text(), plain, max_size=3),
  path=st.none() | st.just(Path("a/b")),
)


@given(whole=wholes)
def test_json_and_back_is_the_same(whole):
  assert from_plain(json.loads(json.dumps(to_plain(whole))), Whole) == whole


@given(value=plain)
def test_plain_values_stay(value):
  assert to_plain(value) == value


def test_the_form_is_that_of_the_fields():
  assert to_plain(Part("a", (1, 2), (0.5, 1))) == {
    "name": "a",
    "sizes": [1, 2],
    "pair": [0.5, 1],
    "colour": "red",
    "range": {"low": 0.0, "high": 1.0},
  }
  assert to_plain({"x": (np.float32(0.5), np.int64(3)), 2: Path("p")}) == {"x": [0.5, 3], "2": "p"}


def test_arrays_keep_their_type():
  arrays = Arrays(np.eye(2), np.array([[1, 255]], np.uint8))
  again = from_plain(json.loads(json.dumps(to_plain(arrays))), Arrays)
  np.testing.assert_array_equal(again.matrix, arrays.matrix)
  np.testing.assert_array_equal(again.pixels, arrays.pixels)
  assert again.matrix.dtype == np.float64 and again.pixels.dtype == np.uint8
  assert again.missing is None


def test_files(tmp_path):
  path = tmp_path / "whole.json"
  write_json(path, Whole(part=Part("a")))
  assert read_json(path, Whole) == Whole(part=Part("a"))
  path.write_text('{"part": ')
  with pytest.raises(SerializationError, match=r"whole\.json is no valid JSON"):
    read_json(path, Whole)


@pytest.mark.parametrize(
  "values, reason",
  [
    (
      {"part": {"name": "a", "nane": "b"}},
      r"unknown fields 'nane' .*some of name, sizes",
    ),
    ({"part": {}}, "the field 'name' is missing"),
    ({"part": {"name": "a", "sizes": [1, "2"]}}, r"expected int, found '2' @ \.part\.sizes\[1\]"),
    ({"part": {"name": "a"}, "on": "no"}, r"expected bool, found 'no' @ \.on"),
    ({"part": {"name": "a"}, "rate": True}, r"expected float, found True @ \.rate"),
    ({"part": {"name": "a"}, "count": 1.5}, r"expected int, found 1\.5 @ \.count"),
    ({"part": {"name": 1}, "colour": 2}, r"expected str, found 1.*unknown fields 'colour'"),
    (3, "Whole: "),
  ],
)
def test_what_does_not_fit_is_named(values, reason):
  with pytest.raises(SerializationError, match=reason) as caught:
    from_plain(values, Whole)
  assert "\n" not in str(caught.value)


def test_numbers_that_other_programs_write_are_accepted():
  whole = from_plain({"part": {"name": "a"}, "rate": 1, "count": 3.0}, Whole)
  assert type(whole.rate) is float and type(whole.count) is int and whole.count == 3
