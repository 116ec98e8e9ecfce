"""The example in the README runs, and the README lists what is there."""

import re
from pathlib import Path

from nerf2real import core

FOLDER = Path(core.__file__).parent


def test_the_readme_example_runs():
  (example,) = re.findall(r"```python\n(.*?)```", (FOLDER / "README.md").read_text(), re.DOTALL)
  names: dict = {"__name__": "example"}
  exec(example, names)
  assert names["again"] == names["settings"]
  assert [path.name for path in names["folder"].parent.iterdir()] == ["result"]


def test_the_readme_lists_every_module():
  text = (FOLDER / "README.md").read_text()
  there = {path.name for path in FOLDER.glob("*.py")} - {"__init__.py"}
  there |= {f"{path.parent.name}/" for path in FOLDER.glob("*/__init__.py")}
  assert set(re.findall(r"^\| `(.*?)` \|", text, re.MULTILINE)) == there


def test_core_imports_no_other_package():
  for path in FOLDER.rglob("*.py"):
    imported = re.findall(r"^\s*(?:from|import) nerf2real\.(\w+)", path.read_text(), re.MULTILINE)
    assert set(imported) <= {"core"}, path
