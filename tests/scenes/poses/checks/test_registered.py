"""Tests of how many keyframes must have a place."""

import pytest

from nerf2real.scenes.poses.checks.registered import check_registered, needed
from nerf2real.scenes.poses.localisation import LocalisationError
from nerf2real.scenes.poses.settings import LocaliseSettings


@pytest.mark.parametrize(
  ("count", "least"), [(8, 6), (9, 7), (10, 8), (12, 8), (16, 8), (20, 10), (300, 150)]
)
def test_half_must_have_a_place_and_of_few_three_quarters(count, least):
  assert needed(count, LocaliseSettings()) == least


def test_the_error_says_how_many_and_which():
  names = [f"{k}.png" for k in range(8)]
  with pytest.raises(LocalisationError, match="0 of 8 .* expected at least 6: probably") as error:
    check_registered(None, names, LocaliseSettings(), None, film=False)
  assert error.value.missing == frozenset(names)
