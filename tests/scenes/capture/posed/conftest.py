"""A recording that the tests of posed captures share."""

import pytest

from tests.scenes.capture.posed.sequences import tum_sequence


@pytest.fixture(scope="module")
def tum(tmp_path_factory):
  return tum_sequence(tmp_path_factory.mktemp("tum"))
