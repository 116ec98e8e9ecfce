"""What the search for a faster walker tries, and what it calls better."""

import numpy as np
import pytest

from benchmarks.learning import faster_walker
from benchmarks.learning.faster_walker import GAIT, STEERING, Walk
from nerf2real.agents.distill.teacher import TEACHERS


def test_the_search_begins_at_its_walker_and_moves_by_widths_within_the_joints() -> None:
  swift = TEACHERS["swift"]()
  there = np.zeros(len(GAIT) + len(STEERING))
  assert faster_walker.walker_at(swift, there) == swift
  far = faster_walker.walker_at(swift, there + 4.0)
  assert far.gait.stride == pytest.approx(swift.gait.stride + 4 * GAIT["stride"])
  assert far.steering.turn_gain == pytest.approx(
    swift.steering.turn_gain + 4 * STEERING["turn_gain"]
  )
  assert far.gait.max_turn == 0.3
  assert far.steering.head_tilt == swift.steering.head_tilt


def test_a_sooner_arrival_is_better_and_a_fall_worse_than_any_walk() -> None:
  soon, late, fell = Walk(True, 6.0), Walk(True, 24.0), Walk(False, 3.0)
  assert faster_walker.score([soon]) == pytest.approx(0.5)
  assert faster_walker.score([soon]) > faster_walker.score([late]) > faster_walker.score([fell])
  assert faster_walker.score([soon, fell]) == pytest.approx(-0.75)
