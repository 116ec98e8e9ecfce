"""What the report draws of the cameras: a film's path, or the places of photographs."""

from typing import Any

import numpy as np
import pytest

from nerf2real.core import floor_map, palette
from nerf2real.scenes.quality import report


@pytest.mark.parametrize(("filmed", "word"), [(True, "line"), (False, "dots")])
def test_photographs_are_places_and_no_path(filmed, word):
  cameras = np.array([[-0.8, 0.0, 1.0], [0.8, 0.0, 1.0]])
  reachable = np.ones((40, 40), bool)
  floor = floor_map.Floor(reachable=reachable, resolution=0.05, origin=np.array([-1.0, -1.0]))
  drawn = floor_map.FloorMap.of(floor, height=200)
  data: Any = type("Data", (), {})()
  data.floor, data.cameras, data.filmed, data.goals = drawn, cameras, filmed, np.zeros((0, 2))
  section = report._free_space(data)
  assert f"the {word} " in section.text
  picture = section.blocks[0].cells[0].image
  orange = np.array(palette.rgb(palette.VERMILION))

  def is_orange(x):
    return (picture[100, round(100 * (x + 1))] == orange).all()

  assert is_orange(-0.8) and is_orange(0.8)
  assert is_orange(0.0) == filmed  # between the two
