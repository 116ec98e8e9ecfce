"""The example in the READMEs writes a log that can be read; all files are in their tables."""

import pathlib
import re

import numpy as np

from nerf2real import sysid
from nerf2real.core.robot_logs.reading import read_log


def test_the_example_writes_a_log(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  text = (pathlib.Path(sysid.__file__).parent / "data" / "README.md").read_text()
  (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
  exec(compile(code, "README.md", "exec"), {})
  log = read_log(tmp_path / "train_1.mcap")
  assert log.joints == ("elbow",)
  assert log.duration > 11 and np.ptp(log.states.position) > 0.9


def test_every_file_is_in_a_table():
  folder = pathlib.Path(sysid.__file__).parent
  text = "".join(path.read_text() for path in folder.rglob("README.md"))
  missing = []
  for path in folder.rglob("*.py"):
    place = path.relative_to(folder)
    named = (f"`{place}`", f"`{place.name}`", f"`{place.parent}/`")
    if place.name != "__init__.py" and not any(name in text for name in named):
      missing.append(str(place))
  assert missing == []
