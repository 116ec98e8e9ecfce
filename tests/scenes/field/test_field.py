import dataclasses

import jax
import numpy as np
import pytest

from nerf2real.core.serialization import to_plain
from nerf2real.scenes.field.field import Field, FieldSettings, init_params, query
from nerf2real.scenes.field.settings import TrainSettings, preset

SETTINGS = FieldSettings(levels=2, log2_table_size=6, base_resolution=4, growth=2.0, width=16)


def _inputs(count=20):
  rng = np.random.default_rng(0)
  directions = rng.normal(size=(count, 3)).astype(np.float32)
  directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
  positions = rng.normal(size=(count, 3)).astype(np.float32)
  return positions, np.full((count, 3), 1e-5, np.float32), directions


def test_query_shapes_ranges_and_density():
  params = init_params(jax.random.PRNGKey(0), SETTINGS)
  positions, variances, directions = _inputs()
  density, color = query(SETTINGS, params, positions, variances, directions)
  assert density.shape == (20,) and color.shape == (20, 3)
  assert (np.asarray(density) > 0).all()
  assert (np.asarray(color) > 0).all() and (np.asarray(color) < 2).all()


def test_density_is_squareplus_with_bias_by_hand():
  params = {k: np.zeros_like(v) for k, v in init_params(jax.random.PRNGKey(0), SETTINGS).items()}
  params["base_b2"][0] = 6.5 / SETTINGS.density_gain  # 6.5 - 5 = 1.5; (1.5 + sqrt(6.25)) / 2 = 2
  density, color = query(SETTINGS, params, *_inputs(3))
  np.testing.assert_allclose(density, SETTINGS.density_scale * 2.0, rtol=1e-6)
  specular = 1 / (1 + np.exp(3.0))
  np.testing.assert_allclose(color, 0.5 + specular, rtol=1e-6)


def test_density_does_not_depend_on_direction():
  params = init_params(jax.random.PRNGKey(1), SETTINGS)
  positions, variances, directions = _inputs()
  one, _ = query(SETTINGS, params, positions, variances, directions)
  other, _ = query(SETTINGS, params, positions, variances, -directions)
  np.testing.assert_array_equal(one, other)


def test_file_keeps_everything_and_rounds_only_the_table(tmp_path):
  params = init_params(jax.random.PRNGKey(0), SETTINGS)
  settings = dataclasses.replace(SETTINGS, march_step=0.02)
  Field(settings, params, 0.00123).save(tmp_path / "field.safetensors")
  assert [p.name for p in tmp_path.iterdir()] == ["field.safetensors"]
  found = Field.load(tmp_path / "field.safetensors")
  assert found.settings == settings and found.training_pixel_angle == 0.00123
  for name, value in params.items():
    if name == "table":
      np.testing.assert_allclose(found.params[name], value, atol=1e-5)
      np.testing.assert_array_equal(found.params[name], np.float16(value).astype(np.float32))
    else:
      np.testing.assert_array_equal(found.params[name], value)


def test_file_of_another_kind_is_refused(tmp_path):
  import safetensors.numpy

  safetensors.numpy.save_file({"a": np.zeros(2, np.float32)}, tmp_path / "a.safetensors")
  with pytest.raises(ValueError, match="holds no radiance field"):
    Field.load(tmp_path / "a.safetensors")


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.6, 0.999])
def test_a_file_that_was_cut_off_is_one_line(tmp_path, share):
  path = tmp_path / "field.safetensors"
  Field(SETTINGS, init_params(jax.random.PRNGKey(0), SETTINGS), 0.002).save(path)
  whole = path.read_bytes()
  path.write_bytes(whole[: int(share * len(whole))])
  with pytest.raises(ValueError, match=r"field\.safetensors is damaged: found .* bytes") as caught:
    Field.load(path)
  assert "expected a radiance field" in str(caught.value)
  assert "make the bundle again" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("rule", ["additive", "paper"])
def test_files_with_the_former_footprint_rule(tmp_path, monkeypatch, rule):
  path = tmp_path / "field.safetensors"
  with monkeypatch.context() as before:
    former = {**to_plain(SETTINGS), "footprint_rule": rule}
    before.setattr("nerf2real.scenes.field.field.to_plain", lambda settings: former)
    Field(SETTINGS, init_params(jax.random.PRNGKey(0), SETTINGS), 0.002).save(path)
  if rule == "additive":
    assert Field.load(path).settings == SETTINGS
    return
  with pytest.raises(
    ValueError, match=r"field\.safetensors was trained with footprint_rule='paper'"
  ):
    Field.load(path)


def test_settings_refuse_nonsense():
  with pytest.raises(ValueError, match="levels=0"):
    FieldSettings(levels=0)


def test_training_ends_by_whichever_limit_comes_first():
  settings = TrainSettings(max_steps=100, max_seconds=10.0)
  assert settings.fraction_done(50, 2.0) == 0.5
  assert settings.fraction_done(50, 8.0) == 0.8
  assert TrainSettings(max_seconds=10.0).fraction_done(10**6, 5.0) == 0.5
  for wrong in ({"max_seconds": None}, {"max_seconds": -5.0}, {"max_steps": 0}):
    with pytest.raises(ValueError, match="expected at least one step or a positive time"):
      TrainSettings(**wrong)


def test_quality_is_fast_with_more_time():
  fast, quality = preset("fast"), preset("quality")
  assert quality.max_seconds == 3600.0
  assert dataclasses.replace(quality, max_seconds=fast.max_seconds) == fast


def test_paper_preset_holds_the_papers_table():
  settings = preset("paper")
  field = settings.field
  assert (field.levels, 2**field.log2_table_size) == (12, 2**20)
  assert (field.width, field.view_width, field.density_bias) == (64, 32, -5.0)
  assert (settings.proposal_samples, settings.final_samples) == (64, 64)
  assert (settings.proposal_width, settings.proposal_depth) == (64, 2)
  assert (settings.batch_rays, settings.max_steps, settings.warmup_steps) == (16384, 40000, 2048)
  assert (settings.learning_rate, settings.final_learning_rate) == (2e-3, 4e-5)
  assert (settings.weight_decay, settings.sample_dilation) == (5e-5, 0.001)
  assert (settings.charbonnier_padding, settings.distortion_weight) == (0.001, 0.01)
  assert (settings.blur_max, settings.engine) == (12.0, "jax")
