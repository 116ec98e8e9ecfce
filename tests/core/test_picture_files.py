"""Pictures come back as they were written, or an error is raised."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from nerf2real.core.files import DiskFullError
from nerf2real.core.picture_files import write_picture

PICTURE = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)


def test_a_picture_comes_back(tmp_path):
  write_picture(tmp_path / "a.png", PICTURE, (cv2.IMWRITE_PNG_COMPRESSION, 1))
  np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png")), PICTURE)


def test_what_cannot_be_written_is_an_error(tmp_path):
  with pytest.raises(FileNotFoundError):
    write_picture(tmp_path / "absent" / "a.png", PICTURE)
  with pytest.raises(ValueError, match="give .png"):
    write_picture(tmp_path / "a.unknown", PICTURE)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_told(tmp_path):
  (tmp_path / "a.png").symlink_to("/dev/full")
  with pytest.raises(DiskFullError, match="the disk is full"):
    write_picture(tmp_path / "a.png", PICTURE)
