"""The examples in the READMEs run."""

import re
from pathlib import Path

import numpy as np
import pytest

from nerf2real import scenes
from nerf2real.scenes.builtin import mujoco_renderer


def _run(*parts):
  text = Path(scenes.__file__).parent.joinpath(*parts).read_text()
  (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
  names: dict = {}
  exec(example, names)
  return names


def test_the_readme_example_sees_the_room():
  names = _run("README.md")
  assert names["color"].shape == (30, 40, 3) and names["color"].std() > 10
  metres = names["depth"] * names["bundle"].world_from_unit.scale
  assert 0.1 < np.median(metres) < 6
  assert names["bundle"].free_space.is_reachable(names["start"])


def test_the_built_in_rooms_example_runs():
  try:
    _run("builtin", "README.md")
  except mujoco_renderer.EglMissingError as error:
    pytest.skip(str(error))
