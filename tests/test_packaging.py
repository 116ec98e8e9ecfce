"""Import names hold wherever the project is used: wheel, editable install, checkout, type checkers.

The build takes its tools from PyPI, so all of this is marked slow.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("core", "scenes", "suite", "agents", "real", "sysid", "evaluation", "launch")
LOAD = (
  "from nerf2real import suite; environment = suite.load('nerf_nav', image_size=None, random=0); "
  "environment.reset(); print(suite.__file__)"
)


def _run(*command, cwd, path=None):
  environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MUJOCO_GL")}
  if path is not None:
    environment["PYTHONPATH"] = str(path)
  found = subprocess.run(
    [str(part) for part in command],
    cwd=cwd,
    env=environment | {"PIP_DISABLE_PIP_VERSION_CHECK": "1"},
    capture_output=True,
    text=True,
    timeout=600,
  )
  assert found.returncode == 0, found.stdout + found.stderr
  return found.stdout.strip()


def _tracked():
  try:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
  except (OSError, subprocess.CalledProcessError):
    pytest.skip("needs a git checkout, to know which files belong to the project")
  return [name for name in listed.stdout.decode().split("\0") if name]


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
  """A copy of the tracked files, so that nothing is built into the real checkout."""
  folder = tmp_path_factory.mktemp("packaging") / "checkout"
  for name in _tracked():
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
  return folder


@pytest.fixture(scope="module")
def wheel(checkout):
  dist = checkout.parent / "dist"
  _run(sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", dist, checkout, cwd=dist.parent)
  (found,) = dist.glob("*.whl")
  return found


def test_the_wheel_has_one_name_and_all_files_of_the_packages(wheel):
  names = set(zipfile.ZipFile(wheel).namelist())
  assert {name.partition("/")[0] for name in names} == {"nerf2real", "nerf2real-0.1.0.dist-info"}
  wanted = {
    f"nerf2real/{name}"
    for name in _tracked()
    if name.partition("/")[0] in PACKAGES and not name.endswith(".md")
  } | {"nerf2real/__init__.py", "nerf2real/py.typed"}
  assert any(name.endswith(".csv") for name in wanted) and len(wanted) > 200
  assert wanted - names == set()


def test_the_wheel_works_outside_the_checkout(wheel, tmp_path):
  site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
  elsewhere.mkdir()
  pip = (sys.executable, "-m", "pip", "install", "--no-deps", "--target", site, wheel)
  _run(*pip, cwd=tmp_path)
  found = _run(sys.executable, "-c", LOAD, cwd=elsewhere, path=site)
  assert Path(found.splitlines()[-1]).is_relative_to(site)
  assert {path.name for path in site.iterdir()} == {"nerf2real", "nerf2real-0.1.0.dist-info", "bin"}
  listed = _run(site / "bin" / "nerf2real", "--help", cwd=elsewhere, path=site)
  assert "  evaluate  " in listed


@pytest.fixture(scope="module")
def editable(checkout):
  """An interpreter with an editable install of the checkout, and this one's other packages."""
  folder = checkout.parent / "venv"
  _run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=checkout.parent)
  python = folder / "bin" / "python"
  pip = (sys.executable, "-m", "pip", "--python", python)
  _run(*pip, "install", "--no-deps", "--editable", checkout, cwd=checkout.parent)
  (site,) = folder.glob("lib/python*/site-packages")
  (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
  return python


def test_an_editable_install_is_a_plain_path(editable, checkout, tmp_path):
  (site,) = editable.parents[1].glob("lib/python*/site-packages")
  lines = [path.read_text().strip() for path in site.glob("__editable__*.pth")]
  assert lines == [str(checkout)]  # no import hook, which type checkers cannot follow
  assert Path(_run(editable, "-c", LOAD, cwd=tmp_path)).is_relative_to(checkout)


def test_packages_are_importable_by_their_folders_in_the_checkout(editable, checkout):
  code = "import suite; print(suite.load('nerf_nav', image_size=None).reset().first())"
  assert _run(editable, "-c", code, cwd=checkout) == "True"


@pytest.fixture
def user_code(tmp_path):
  path = tmp_path / "user_code.py"
  path.write_text('from nerf2real import suite\nreveal_type(suite.load("x"))\n')
  return path


def test_mypy_knows_the_types_from_outside(editable, user_code):
  out = _run(
    *(sys.executable, "-m", "mypy", "--python-executable", editable, user_code.name),
    cwd=user_code.parent,
  )
  assert re.search(r'Revealed type is "nerf2real\.suite\.environment\.Environment', out), out


def test_pyright_knows_the_types_from_outside(editable, user_code):
  """An IDE's resolver; `pip install basedpyright` brings one that needs nothing but PyPI."""
  program = shutil.which("basedpyright") or shutil.which("pyright")
  if program is None:
    pytest.skip("needs pyright or basedpyright on the PATH")
  found = subprocess.run(
    [program, "--pythonpath", editable, "--outputjson", user_code.name],
    cwd=user_code.parent,
    capture_output=True,
    text=True,
    timeout=600,
  )
  messages = [entry["message"] for entry in json.loads(found.stdout)["generalDiagnostics"]]
  assert 'Type of "suite.load("x")" is "Environment"' in messages
