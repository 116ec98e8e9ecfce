"""Checks of captures of other kinds: a reason at once, or a verdict that the scene reuses."""

import json
import shutil
import types

import cv2
import numpy as np
import pytest

from nerf2real.core.folder_lock import FolderInUseError, lock_folder
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes import checking
from nerf2real.scenes.bundle import STAGES
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.quality import advice
from nerf2real.scenes.settings import preset
from nerf2real.scenes.stages import localising
from tests.scenes import furnished_room


def test_pictures_of_nothing_get_a_verdict_with_the_reason(tmp_path):
  """Pictures that share nothing: no poses, but one clear reason and the blur."""
  folder = tmp_path / "flat"
  folder.mkdir()
  for number in range(12):
    grey = np.full((120, 160, 3), 60 + 10 * number, np.uint8)
    cv2.imwrite(str(folder / f"{number:02d}.jpg"), grey)
  verdict = checking.check_capture(
    folder, tmp_path / "out", settings=preset("fast"), show_progress=False
  )
  assert not verdict.good and verdict.picture is None
  assert "0 of 12 keyframes were localised" in verdict.words
  assert "Without a place: 00.jpg, 01.jpg, 02.jpg, 03.jpg and 8 more" in verdict.words
  assert "take pictures from places in between" in verdict.words
  assert "blurred, as 00.jpg" in verdict.words
  assert (tmp_path / "out" / STAGES / "keyframes").is_dir()


def test_pictures_of_several_cameras_are_one_clear_line(tmp_path):
  folder = tmp_path / "flat"
  folder.mkdir()
  for number in range(10):
    size = (120, 160, 3) if number < 6 else (90, 160, 3)
    cv2.imwrite(str(folder / f"{number:02d}.jpg"), np.full(size, 60 + 10 * number, np.uint8))
  with pytest.raises(CaptureError, match="expected one camera and one zoom"):
    checking.check_capture(folder, tmp_path / "out", settings=preset("fast"), show_progress=False)


def test_a_folder_of_another_capture_or_in_use_is_left_alone(tmp_path):
  film, out = tmp_path / "hall.mp4", tmp_path / "out"
  film.write_bytes(b"a film")
  with lock_folder(out), pytest.raises(FolderInUseError):
    checking.check_capture(film, out, settings=preset("fast"), show_progress=False)
  out.mkdir()
  (out / "scene.json").write_text(json.dumps({"source": {"name": "room.mp4", "sha256": "0"}}))
  with pytest.raises(ValueError, match=r"holds a scene of room.mp4, found the capture hall.mp4"):
    checking.check_capture(film, out, settings=preset("fast"), show_progress=False)
  assert [path.name for path in out.iterdir()] == ["scene.json"]


def _sized(monkeypatch, tmp_path, *, sensed=False, override=None):
  """Checks a room whose poses are in half metres; returns the height of its cameras [m]."""
  rng = np.random.default_rng(0)
  poses = furnished_room.walk(12)
  poses[:, :3, 3] *= 2
  points = np.column_stack([rng.uniform(-4, 4, (2000, 2)), rng.normal(0, 0.004, 2000)])
  found = types.SimpleNamespace(
    points=points,
    world_from_camera=poses,
    names=[],
    camera=None,
    unit_from_source=Similarity(2.0, np.eye(3), np.zeros(3)),
  )
  known = types.SimpleNamespace(is_metric=True, names_unit=True) if sensed else None
  capture = types.SimpleNamespace(known=known, unit_up=None)
  made = types.SimpleNamespace(value=capture, stamp="keyframes")
  monkeypatch.setattr(localising, "keyframes", lambda *_: made)
  monkeypatch.setattr(
    localising, "poses", lambda *_: types.SimpleNamespace(value=found, stamp="poses")
  )
  monkeypatch.setattr(advice, "judge", lambda *_, **given: given["frame"])
  film = tmp_path / "film.mp4"
  film.write_bytes(b"a film")
  frame = checking.check_capture(
    film, tmp_path / "out", settings=preset("fast"), override=override, show_progress=False
  )
  return frame.scale_source, frame.camera_height


def test_a_check_has_the_scale_that_the_scene_will_have(monkeypatch, tmp_path):
  height = np.median(furnished_room.walk(12)[:, 2, 3])
  assert _sized(monkeypatch, tmp_path) == ("unknown", pytest.approx(1.4, abs=0.02))
  (tmp_path / "override.yaml").write_text("scale: 0.5")
  fixed = _sized(monkeypatch, tmp_path, override=tmp_path / "override.yaml")
  assert fixed == ("manual", pytest.approx(height, abs=0.02))
  shutil.rmtree(tmp_path / "out")
  sensed = _sized(monkeypatch, tmp_path, sensed=True)
  assert sensed == ("depth_sensor", pytest.approx(height, abs=0.02))
