"""What long walks count as worth, and that a walk is measured as it went."""

import concurrent.futures

import pytest

from benchmarks.learning import long_walks
from benchmarks.learning.long_walks import COMMANDS, Settings, Walk, worth
from nerf2real.agents.distill.teacher import TEACHERS, WalkerSettings
from nerf2real.core.serialization import read_json


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_a_fall_is_worse_than_any_walk_and_more_of_what_was_commanded_is_better(command) -> None:
  slow, fast = Walk(0.1, 0.05, False), Walk(0.2, 0.1, False)
  assert worth(command, Walk(0.3, 1.2, True)) < 0 < worth(command, slow) < worth(command, fast)


def test_turning_away_costs_only_where_no_turn_was_commanded() -> None:
  straight, spun = Walk(0.25, 0.0, False), Walk(0.25, 0.5, False)
  assert worth(COMMANDS["straight"], spun) < worth(COMMANDS["straight"], straight)
  assert worth(COMMANDS["bent"], spun) == worth(COMMANDS["bent"], straight)


def test_a_walk_goes_as_commanded_and_noise_disturbs_it() -> None:
  swift = TEACHERS["swift"]()
  how = {"seconds": 2.0, "seed": 0}
  ahead = long_walks.walk(swift, 0, COMMANDS["straight"], noise=0.0, **how)
  turned = long_walks.walk(swift, 0, COMMANDS["on the spot"], noise=0.0, **how)
  noisy = long_walks.walk(swift, 0, COMMANDS["straight"], noise=0.1, **how)
  assert not ahead.fell and ahead.speed > 0.1 > abs(ahead.turn)
  assert turned.turn > 0.5 and turned.speed < ahead.speed
  assert noisy != ahead


def test_a_search_moves_the_gait_alone_and_writes_where_it_stands(tmp_path) -> None:
  found = tmp_path / "walker.json"
  settings = Settings(
    walkers=("brisk",), minutes=1e-4, population=2, seconds=0.5, searched=(0,), found=found
  )
  with concurrent.futures.ThreadPoolExecutor(1) as pool:
    walker = long_walks.search(settings, pool)
  brisk = TEACHERS["brisk"]()
  assert read_json(found, WalkerSettings) == walker
  assert walker.steering == brisk.steering and walker.gait != brisk.gait
