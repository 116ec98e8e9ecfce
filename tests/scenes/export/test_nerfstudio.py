"""The nerfstudio export of a film with a rolling shutter: pictures that fit their poses."""

import errno
import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from nerf2real.core import files
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.capture.posed.transforms import read_transforms
from nerf2real.scenes.export import nerfstudio
from nerf2real.scenes.poses import localisation
from nerf2real.scenes.poses.film.readout import motion
from tests.scenes.poses.film.test_readout import CAMERA, PICTURES, filmed


def _bundle(folder, readout, picture, **scene):
  """A bundle of a film's poses and keyframes, all of them the same picture."""
  model, times = filmed(readout or 0.0)
  moved = None if readout is None else motion(model, times, readout)
  figures = {
    "reprojection_error_px": 0.3,
    "registered_fraction": 1.0,
    "strategy": "made",
    "unit_from_source": Similarity(),
    "shutter": moved,
  }
  found = localisation.from_model(model, figures)
  localisation.save(model, found, folder / "sfm")
  keyframes = folder / "keyframes" / "images"
  keyframes.mkdir(parents=True)
  for name in found.names:
    cv2.imwrite(str(keyframes / name), picture)
  bundle = SimpleNamespace(
    folder=folder, keyframes_folder=keyframes, world_from_unit=Similarity(), scene=scene
  )
  return bundle, moved


def _grid():
  picture = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
  picture[:, ::16], picture[::16] = 255, 255
  return picture


@pytest.mark.parametrize("readout", [0.03, None])
def test_exported_pictures_are_those_the_poses_belong_to(readout, tmp_path):
  picture = _grid()
  bundle, moved = _bundle(tmp_path, readout, picture)
  words = nerfstudio.write(tmp_path / "out", bundle)
  assert words == "keyframes"
  read = read_transforms(tmp_path / "out")
  assert len(read.files) == PICTURES
  for index, file in enumerate(read.files):
    expected = picture if moved is None else moved.rectify(picture, CAMERA, index)
    np.testing.assert_array_equal(cv2.imread(str(file)), expected)
  if moved is not None:
    assert not np.array_equal(cv2.imread(str(read.files[7])), picture)


def test_keyframes_of_another_scene_are_not_exported(tmp_path):
  bundle, _ = _bundle(tmp_path, None, _grid(), hashes={"keyframes": "of the scene"})
  record = tmp_path / "keyframes" / "stage.json"
  record.write_text(json.dumps({"key": "of another"}))
  with pytest.raises(ValueError, match="holds other keyframes than the scene was made of"):
    nerfstudio.write(tmp_path / "out", bundle)
  assert not (tmp_path / "out").exists()
  record.write_text(json.dumps({"key": "of the scene"}))
  assert nerfstudio.write(tmp_path / "out", bundle) == "keyframes"


def test_a_picture_that_cannot_be_written_is_no_export(monkeypatch, tmp_path):
  bundle, _ = _bundle(tmp_path, 0.03, _grid())

  def full(path, image, *rest):
    raise OSError(errno.ENOSPC, "No space left on device", str(path))

  monkeypatch.setattr(nerfstudio, "write_picture", full)
  with pytest.raises(files.DiskFullError):
    nerfstudio.write(tmp_path / "out", bundle)
  assert not (tmp_path / "out").exists()
