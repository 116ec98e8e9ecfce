"""The whole job on a few frames of the shipped film: caching, resuming, the bundle, clear errors.

Poses come with the pictures (transforms.json), so that no time goes into localisation, which has
tests of its own.
"""

import dataclasses
import json
import shutil

import av
import cv2
import numpy as np
import pytest

from nerf2real.scenes import bundle, pipeline
from nerf2real.scenes.builtin import filming, ground_truth
from nerf2real.scenes.bundle import Bundle, BundleError
from nerf2real.scenes.export.views import capture_cameras
from nerf2real.scenes.field.settings import preset as train_preset
from nerf2real.scenes.geometry import collision as contact
from nerf2real.scenes.geometry import decomposition
from nerf2real.scenes.geometry.mesh import MeshSettings
from nerf2real.scenes.settings import preset
from tests.scenes import synthetic_capture as synthetic

_FRAMES = 40
_SIZE = (160, 120)  # width, height


@pytest.fixture(scope="module")
def source(tmp_path_factory):
  """Frames of the film with their true poses, as nerfstudio writes them."""
  folder = tmp_path_factory.mktemp("capture")
  (folder / "images").mkdir()
  truth = filming.read_truth(ground_truth.TRUTH)
  wanted = np.linspace(0, len(truth["world_from_camera"]) - 1, _FRAMES).astype(int)
  files = []
  with av.open(str(ground_truth.VIDEO)) as container:
    for index, frame in enumerate(container.decode(video=0)):
      if index in wanted:
        picture = cv2.resize(frame.to_ndarray(format="bgr24"), _SIZE, interpolation=cv2.INTER_AREA)
        name = f"images/{index:05d}.png"
        cv2.imwrite(str(folder / name), picture)
        files.append(name)
  poses = truth["world_from_camera"][wanted]
  synthetic.write_frames(folder, files, poses, truth["camera"].resized(*_SIZE))
  return folder / "transforms.json"


@pytest.fixture(scope="module")
def settings():
  base = preset("fast")
  field = dataclasses.replace(base.train.field, levels=8, log2_table_size=15)
  return dataclasses.replace(
    base,
    train=dataclasses.replace(
      train_preset("fast"), field=field, max_steps=150, max_seconds=None, batch_samples=1 << 14
    ),
    align=dataclasses.replace(base.align, camera_height=1.0),
    stereo=dataclasses.replace(base.stereo, width=80),
    depth_width=80,
    mesh=MeshSettings(voxel=0.08, truncation=0.24),
    collision=contact.CollisionSettings(
      voxel=0.1,
      truncation=0.25,
      top=1.0,
      parts=decomposition.ConvexSettings(tolerance=0.3, max_parts=100),
    ),
  )


@pytest.fixture(scope="module")
def scene(source, settings, tmp_path_factory):
  out = tmp_path_factory.mktemp("scenes") / "room"
  return pipeline.make_scene(source, out, settings=settings, show_progress=False)


def test_bundle_is_whole_and_metric(scene):
  figures = scene.figures
  assert figures["registered_fraction"] == 1.0
  assert figures["held_out_psnr_db"] > 15  # seconds of training; an empty field has less than 9
  assert scene.scene["scale"] == "camera_height"
  lower, upper = scene.extent
  assert 3 < (upper - lower)[0] < 12
  assert scene.goals.shape == (3, 2)
  assert scene.free_space.is_reachable(scene.goals).all()
  positions, axes = scene.views
  _, poses, _ = capture_cameras(scene)
  np.testing.assert_allclose(positions, poses[:, :3, 3], atol=1e-3)
  np.testing.assert_allclose(axes, poses[:, :3, 2], atol=1e-3)
  assert (positions > lower).all() and (positions < upper).all()
  assert set(scene.scene["seconds"]) >= {"keyframes", "poses", "field", "world", "contact"}


def test_report_is_one_file_that_opens_offline(scene):
  page = (scene.folder / "report.html").read_text()
  assert page.count("data:image/") > 20
  for text in ("Held-out views", "Contact geometry", "Free space", "held_out_psnr_db"):
    assert text in page
  body = page[page.index("<body>") :]
  assert "<img" in body and 'src="http' not in page and "src='http" not in page


def test_second_run_does_nothing_anew(scene, source, settings):
  stamp = (scene.folder / bundle.STAGES / "field" / "field.safetensors").stat().st_mtime_ns
  again = pipeline.make_scene(source, scene.folder, settings=settings, show_progress=False)
  assert again.scene["hashes"] == scene.scene["hashes"]
  assert (scene.folder / bundle.STAGES / "field" / "field.safetensors").stat().st_mtime_ns == stamp


def _stamps(folder):
  """What identifies each stage's run: its name and when it was made."""
  records = (folder / bundle.STAGES).glob("*/stage.json")
  return {path.parent.name: json.loads(path.read_text())["made"] for path in records}


def test_changed_settings_repeat_only_their_stage(scene, source, settings, tmp_path):
  out = tmp_path / "room"
  shutil.copytree(scene.folder, out)
  coarser = dataclasses.replace(
    settings, mesh=dataclasses.replace(settings.mesh, visual_faces=3000)
  )
  pipeline.make_scene(source, out, settings=coarser, show_progress=False)
  before, after = _stamps(scene.folder), _stamps(out)
  assert before.keys() == after.keys()
  assert {name for name in before if before[name] != after[name]} == {"surface"}


def test_changed_alignment_keeps_the_field_but_not_the_contact(scene, source, settings, tmp_path):
  out = tmp_path / "room"
  shutil.copytree(scene.folder, out)
  fixed = tmp_path / "fix.yaml"
  fixed.write_text("scale: 2.0\n")
  changed = pipeline.make_scene(source, out, settings=settings, override=fixed, show_progress=False)
  before, after = scene.scene["hashes"], changed.scene["hashes"]
  assert after["field"] == before["field"]
  assert after["world"] != before["world"] and after["contact"] != before["contact"]
  kept = {"keyframes", "poses", "stereo", "field", "depth", "figures"}
  made, made_again = _stamps(scene.folder), _stamps(out)
  assert {name for name in made if made[name] == made_again[name]} == kept
  assert changed.world_from_unit.scale == pytest.approx(2.0)
  assert changed.scene["scale"] == "manual"


def test_incomplete_bundles_are_refused(scene, tmp_path):
  with pytest.raises(BundleError, match="not a folder"):
    Bundle.load(tmp_path / "absent")
  with pytest.raises(BundleError, match=r"no scene\.json"):
    Bundle.load(tmp_path)
  out = tmp_path / "room"
  shutil.copytree(scene.folder, out, ignore=shutil.ignore_patterns(bundle.STAGES))
  (out / "field.safetensors").unlink()
  with pytest.raises(BundleError, match=r"lacks field\.safetensors"):
    Bundle.load(out)
  (out / "scene.json").write_text("{broken")
  with pytest.raises(BundleError, match="damaged"):
    Bundle.load(out)
  (out / "scene.json").write_text('{"format": "scene-bundle", "format_version": 99}')
  with pytest.raises(BundleError, match="expected"):
    Bundle.load(out)


def test_the_folder_that_one_is_in_names_the_scene(source, settings, tmp_path, monkeypatch):
  (tmp_path / "room").mkdir()
  monkeypatch.chdir(tmp_path / "room")
  monkeypatch.setattr(pipeline, "_run_stages", lambda *_, name, **__: name)
  assert pipeline.make_scene(source, ".", settings=settings) == "room"


def test_no_source_is_one_clear_line(settings, tmp_path):
  with pytest.raises(ValueError, match="does not exist"):
    pipeline.make_scene(tmp_path / "none.mp4", tmp_path / "out", settings=settings)
  assert not (tmp_path / "out" / "scene.json").exists()


def test_a_scene_of_another_capture_is_not_overwritten(settings, tmp_path):
  other, out = tmp_path / "hall.mp4", tmp_path / "room"
  other.write_bytes(b"another film")
  out.mkdir()
  made_from = {"source": {"name": "room.mp4", "sha256": "0"}}
  (out / "scene.json").write_text(json.dumps(made_from))
  with pytest.raises(ValueError, match=r"holds a scene of room.mp4, found the capture hall.mp4"):
    pipeline.make_scene(other, out, settings=settings)
  assert json.loads((out / "scene.json").read_text()) == made_from


def test_built_in_bundle_is_whole():
  scene = Bundle.load()
  assert scene.folder == bundle.BUILT_IN
  assert scene.figures["held_out_psnr_db"] > 30
