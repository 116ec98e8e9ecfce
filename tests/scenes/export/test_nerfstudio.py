"""The nerfstudio export of a film with a rolling shutter: pictures that fit their poses."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from nerf2real.core.similarity import Similarity
from nerf2real.scenes.capture.posed.transforms import read_transforms
from nerf2real.scenes.export import nerfstudio
from nerf2real.scenes.poses import localisation
from nerf2real.scenes.poses.readout import motion
from tests.scenes.poses.test_readout import CAMERA, PICTURES, filmed


@pytest.mark.parametrize("readout", [0.03, None])
def test_exported_pictures_are_those_the_poses_belong_to(readout, tmp_path):
  model, times = filmed(readout or 0.0)
  moved = None if readout is None else motion(model, times, readout)
  found = localisation.from_model(
    model,
    {
      "reprojection_error_px": 0.3,
      "registered_fraction": 1.0,
      "strategy": "made",
      "unit_from_source": Similarity(),
      "shutter": moved,
    },
  )
  localisation.save(model, found, tmp_path / "sfm")
  keyframes = tmp_path / "keyframes"
  keyframes.mkdir()
  picture = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
  picture[:, ::16], picture[::16] = 255, 255
  for name in found.names:
    cv2.imwrite(str(keyframes / name), picture)
  bundle = SimpleNamespace(
    folder=tmp_path, keyframes_folder=keyframes, world_from_unit=Similarity()
  )
  words = nerfstudio.write(tmp_path / "out", bundle)
  assert words == "keyframes"
  read = read_transforms(tmp_path / "out")
  assert len(read.files) == PICTURES
  for index, file in enumerate(read.files):
    expected = picture if moved is None else moved.rectify(picture, CAMERA, index)
    np.testing.assert_array_equal(cv2.imread(str(file)), expected)
  if moved is not None:
    assert not np.array_equal(cv2.imread(str(read.files[7])), picture)
