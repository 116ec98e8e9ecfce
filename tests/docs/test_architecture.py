"""The house keeps its layers, and its picture is true."""

import importlib.util
import re
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def house():
  spec = importlib.util.spec_from_file_location("draw_imports", _ROOT / "docs/draw_imports.py")
  module = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  return module


def test_imports_run_one_way(house):
  assert house.wrong_way(house.imports()) == []


def test_no_folders_import_each_other(house):
  assert house.circles(house.imports()) == []


def test_the_page_is_drawn_from_the_code(house):
  text = house.PAGE.read_text()
  assert house.page(text) == text, "run python docs/draw_imports.py"


def test_every_file_that_the_page_names_exists(house):
  prose = re.sub(r"<!-- \w+: drawn -->.*?<!-- end -->", "", house.PAGE.read_text(), flags=re.DOTALL)
  named = set(re.findall(r"`([a-z_0-9/]+(?:\.py|/))`", prose))
  assert len(named) > 30
  assert [name for name in sorted(named) if not (_ROOT / name).exists()] == []


def test_a_wrong_way_and_a_circle_are_found(house, tmp_path):
  for path, text in {
    "core/files.py": "from nerf2real.scenes import bundle\n",
    "scenes/bundle.py": "",
    "scenes/field/training.py": "from nerf2real.scenes.poses import pairs\n",
    "scenes/poses/pairs.py": "def f():\n  from nerf2real.scenes.field import training\n",
  }.items():
    (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / path).write_text(text)
  edges = house.imports(tmp_path)
  assert house.wrong_way(edges) == [("core.files", "scenes.bundle")]
  assert house.circles(edges) == [("scenes.field", "scenes.poses")]
