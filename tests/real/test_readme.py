"""The example in the README runs."""

import re
from pathlib import Path

from nerf2real import real


def test_the_readme_example_runs():
  text = Path(real.__file__).with_name("README.md").read_text()
  example = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
  names: dict = {}
  exec(example, names)
  assert not names["timestep"].last()
  assert names["timestep"].observation["joint_positions"].shape == (5, 20)
