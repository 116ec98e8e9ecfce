"""The capture that a scene is made of: what its hash holds, and where the scene may not lie."""

import json
import shutil

import pytest

from nerf2real.scenes.source import open_source
from tests.scenes import synthetic_capture as synthetic


def test_changed_pictures_of_a_transforms_file_change_its_hash(tmp_path):
  source, out = tmp_path / "source", tmp_path / "out"
  synthetic.write_transforms(source, synthetic.walk(2), synthetic.CAMERA)
  listed = source / "transforms.json"
  before = open_source(listed, out).sha256
  assert open_source(listed, source / "out").sha256 == before
  names = [frame["file_path"] for frame in json.loads(listed.read_text())["frames"]]
  shutil.copyfile(source / names[0], source / names[1])
  assert open_source(listed, out).sha256 != before


def test_a_scene_in_its_capture_is_refused(tmp_path):
  synthetic.write_transforms(tmp_path / "source", synthetic.walk(2), synthetic.CAMERA)
  for out in (tmp_path / "source", tmp_path / "source" / "out" / "room"):
    with pytest.raises(ValueError, match="lies in the capture .* name a folder beside it"):
      open_source(tmp_path / "source", out)
