import dataclasses
from pathlib import Path

import numpy as np
import pytest

from nerf2real.scenes.field import training as train
from nerf2real.scenes.field.engine.trainer import FusedTrainer
from nerf2real.scenes.field.field import Field, FieldSettings
from nerf2real.scenes.field.occupancy import OccupancySettings, build
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.quality import image_quality
from tests.scenes import box_views

FAST = box_views.TRAINING
REFERENCE = dataclasses.replace(
  FAST,
  engine="jax",
  batch_rays=256,
  proposal_samples=24,
  final_samples=16,
  proposal_levels=1,  # few levels: XLA compiles the step in less time
  proposal_log2_table_size=8,
  proposal_finest_resolution=32,
  max_steps=60,
  field=FieldSettings(levels=2, log2_table_size=10, growth=2.0),
)
SHORT = dataclasses.replace(FAST, max_steps=90, occupancy_start=24, occupancy_sweep_steps=64)


@pytest.fixture(scope="module")
def views():
  return box_views.make_views(60, width=64, height=48)


@pytest.fixture(scope="module")
def trained(views):
  return train.train(views, FAST)


@pytest.fixture(scope="module")
def short(views):
  return train.train(views, SHORT)


def _renderer(field):
  return Renderer(field, occupancy=build(field, settings=OccupancySettings(cells=64)))


@pytest.fixture(scope="module")
def renderer(trained):
  return _renderer(trained[0])


def test_fused_training_reproduces_views_it_has_not_seen(trained, renderer):
  _, report = trained
  held_out = box_views.make_views(3, width=64, height=48, seed=100)
  figures = []
  for index in range(3):
    picture, depth = renderer.render(held_out.camera, held_out.world_from_camera[index])
    figures.append(image_quality.psnr(picture, held_out.images[index]))
    origin, directions = box_views.rays(held_out, index)
    origins = np.broadcast_to(origin, directions.shape).reshape(-1, 3)
    flat = directions.reshape(-1, 3)
    _, _, opacity = renderer.render_rays(origins, flat, held_out.camera.pixel_angle)
    assert opacity.mean() > 0.95
    z = held_out.camera.rays()
    truth = box_views.wall_distance(origin, directions) / np.linalg.norm(z, axis=-1)
    assert np.median(np.abs(depth - truth)) < 0.1
  assert np.mean(figures) > 25
  assert report.steps == 300 and report.resumed_at_step is None
  assert report.samples > report.rays > 300 and report.samples_per_second > 0


def test_same_seed_gives_the_same_field(views, short):
  again, _ = train.train(views, SHORT)
  for name, value in short[0].params.items():
    np.testing.assert_array_equal(again.params[name], value)


def test_interrupted_training_ends_where_the_uninterrupted_one_does(
  views, short, tmp_path, monkeypatch
):
  monkeypatch.setattr(train, "CHECKPOINT_SECONDS", 0.0)
  seen = []

  def interrupt(fraction, text):
    seen.append(fraction)
    if fraction > 0.4:
      raise KeyboardInterrupt

  monkeypatch.setattr(train, "_RECORD_SECONDS", 0.0)
  with pytest.raises(KeyboardInterrupt):
    train.train(views, SHORT, progress=interrupt, checkpoint_dir=tmp_path)
  field, report = train.train(views, SHORT, checkpoint_dir=tmp_path)
  assert report.resumed_at_step is not None and 30 < report.resumed_at_step < 39
  assert report.steps == 90
  for name, value in short[0].params.items():
    np.testing.assert_array_equal(field.params[name], value)


def test_a_checkpoint_of_other_settings_is_not_used(views, tmp_path, monkeypatch):
  monkeypatch.setattr(train, "CHECKPOINT_SECONDS", 0.0)
  short = dataclasses.replace(FAST, max_steps=4)
  train.train(views, short, checkpoint_dir=tmp_path)
  _, report = train.train(views, dataclasses.replace(short, blur_max=0.5), checkpoint_dir=tmp_path)
  assert report.resumed_at_step is None


def test_a_checkpoint_depends_on_all_that_the_training_does(views):
  field = FusedTrainer(views, FAST, seed=0).field()
  anchor = np.array([[0, 1, 1, 2.0]], np.float32)
  runs = [
    (views, None),
    (dataclasses.replace(views, anchors=anchor), None),
    (dataclasses.replace(views, uneven=True), None),
    (views, field),
  ]
  assert len({train._run_key(seen, FAST, 0, initial) for seen, initial in runs}) == len(runs)


def test_a_checkpoint_of_another_format_is_not_used(views, tmp_path, monkeypatch):
  monkeypatch.setattr(train, "CHECKPOINT_SECONDS", 0.0)
  short = dataclasses.replace(FAST, max_steps=4)
  with monkeypatch.context() as before:
    before.setattr(train, "_CHECKPOINT_FORMAT", "1")
    train.train(views, short, checkpoint_dir=tmp_path)
  with pytest.warns(UserWarning, match=r"training\.safetensors is of format 1, expected"):
    _, report = train.train(views, short, checkpoint_dir=tmp_path)
  assert report.resumed_at_step is None and report.steps == 4


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.5, 0.99])
@pytest.mark.parametrize("filled", [False, True])
def test_a_checkpoint_that_was_cut_off_is_one_line_and_training_begins_anew(
  views, tmp_path, monkeypatch, share, filled
):
  """Files end early where a copy stopped, and in zeros where a machine lost its power."""
  monkeypatch.setattr(train, "CHECKPOINT_SECONDS", 0.0)
  short = dataclasses.replace(FAST, max_steps=3)
  train.train(views, short, checkpoint_dir=tmp_path)
  path = tmp_path / "training.safetensors"
  whole = path.read_bytes()
  kept = whole[: int(share * len(whole))]
  path.write_bytes(kept.ljust(len(whole), b"\0") if filled else kept)
  with pytest.warns(UserWarning, match=r"training\.safetensors is damaged") as said:
    _, report = train.train(views, short, checkpoint_dir=tmp_path)
  assert len(said) == 1 and "\n" not in str(said[0].message)
  assert report.resumed_at_step is None and report.steps == 3
  _, report = train.train(views, short, checkpoint_dir=tmp_path)  # it is written anew
  assert report.resumed_at_step == 3


def test_a_run_that_ends_while_it_writes_a_checkpoint_goes_on_from_the_one_before(
  views, tmp_path, monkeypatch
):
  monkeypatch.setattr(train, "CHECKPOINT_SECONDS", 0.0)
  short = dataclasses.replace(FAST, max_steps=6)
  replaced = []

  def cut_off(self, target):
    replaced.append(target)
    if len(replaced) == 4:
      raise KeyboardInterrupt
    return rename(self, target)

  rename = Path.replace
  with monkeypatch.context() as crash:
    crash.setattr(Path, "replace", cut_off)
    crash.setattr(Path, "unlink", lambda self, missing_ok=False: None)  # as after SIGKILL
    with pytest.raises(KeyboardInterrupt):
      train.train(views, short, checkpoint_dir=tmp_path)
  assert len(list(tmp_path.iterdir())) == 2  # the whole one, and what was being written
  _, report = train.train(views, short, checkpoint_dir=tmp_path)
  assert report.resumed_at_step == 3 and report.steps == 6


def test_known_points_make_the_geometry_better(renderer):
  """With as many steps, the field with anchors comes nearer to the walls."""
  anchored = box_views.make_views(60, width=64, height=48, anchors=40)
  field, _ = train.train(anchored, dataclasses.replace(FAST, max_steps=300))
  held_out = box_views.make_views(4, width=64, height=48, seed=100)
  errors = []
  for candidate in (renderer, _renderer(field)):
    off = []
    for index in range(4):
      _, depth = candidate.render(held_out.camera, held_out.world_from_camera[index])
      origin, directions = box_views.rays(held_out, index)
      norms = np.linalg.norm(held_out.camera.rays(), axis=-1)
      off.append(np.abs(depth - box_views.wall_distance(origin, directions) / norms))
    errors.append(np.mean(off))
  assert errors[1] < errors[0], errors


def test_reference_training_lowers_the_loss_and_the_file_is_the_same(tmp_path, monkeypatch):
  monkeypatch.setattr(train, "_RECORD_SECONDS", 0.0)
  views = box_views.make_views(60, width=64, height=48, anchors=20)
  field, report = train.train(views, REFERENCE)
  assert report.engine == "jax" and report.steps == 60
  first, last = report.curve_psnr_db[0], report.curve_psnr_db[-1]
  assert last > first + 2
  field.save(tmp_path / "field.safetensors")
  assert Field.load(tmp_path / "field.safetensors").settings == field.settings


def test_training_that_diverges_says_so_in_one_line(views):
  initial = FusedTrainer(views, FAST, seed=0).field()
  initial.params["base_b2"][:] = np.nan
  with pytest.raises(train.TrainError, match=r"^Training failed at step 1: .* is not finite") as e:
    train.train(views, FAST, initial=initial)
  assert "\n" not in str(e.value)


def test_too_few_pictures_are_refused(views):
  with pytest.raises(train.TrainError, match="Found 2 training pictures"):
    train.train(views.select([0, 1]), FAST)


def test_learning_rate_warms_up_and_decays():
  settings = train.preset("paper")
  assert train.learning_rate(settings, 0.0, 0) < 3e-5
  assert train.learning_rate(settings, 0.0, 2048) == pytest.approx(2e-3)
  assert train.learning_rate(settings, 0.5, 20000) == pytest.approx((2e-3 * 4e-5) ** 0.5)
  assert train.learning_rate(settings, 1.0, 40000) == pytest.approx(4e-5)


def test_unknown_presets_and_engines_are_refused():
  with pytest.raises(ValueError, match="expected 'fast', 'quality' or 'paper'"):
    train.preset("slow")
  with pytest.raises(ValueError, match="expected 'fused' or 'jax'"):
    train.TrainSettings(engine="torch")
