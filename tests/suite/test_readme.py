"""The example in the README runs."""

import re
from pathlib import Path

from nerf2real import suite


def test_the_readme_example_runs():
  text = Path(suite.__file__).with_name("README.md").read_text()
  (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
  names: dict = {}
  exec(example, names)
  assert names["timestep"].reward is not None and not names["timestep"].last()
  assert names["timestep"].observation["camera"].shape == (30, 40, 3)
