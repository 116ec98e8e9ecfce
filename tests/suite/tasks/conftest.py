"""The room and both tasks, once for all files."""

import pytest

from nerf2real.suite.randomisation.draws import NOMINAL
from tests.suite.synthetic import make_room
from tests.suite.tasks.small_room import load


@pytest.fixture(scope="package")
def room(tmp_path_factory):
  return make_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="package")
def nav(room):
  return load("nerf_nav", room, random=0, randomisation=NOMINAL)


@pytest.fixture(scope="package")
def ball(room):
  return load("ball_push", room, random=0, randomisation=NOMINAL)


@pytest.fixture(autouse=True)
def _free_start(request):
  yield
  for name in ("nav", "ball"):
    if name in request.fixturenames:
      request.getfixturevalue(name).task.set_start(None)
