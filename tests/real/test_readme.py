"""The examples in the READMEs run."""

import re
from pathlib import Path

from nerf2real import real

_FOLDER = Path(real.__file__).parent


def _run(readme: Path) -> dict:
  names: dict = {}
  (example,) = re.findall(r"```python\n(.*?)```", readme.read_text(), re.DOTALL)
  exec(example, names)
  return names


def test_the_readme_example_runs():
  timestep = _run(_FOLDER / "README.md")["timestep"]
  assert not timestep.last()
  assert timestep.observation["joint_positions"].shape == (5, 20)


def test_the_virtual_robots_example_runs():
  assert _run(_FOLDER / "virtual" / "README.md")["robot"].port.startswith("rehearsal://")
