"""Tests of localisation: a small reconstruction against the truth."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pycolmap
import pytest

from benchmarks.rooms import fountain
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.progress import no_progress
from nerf2real.scenes.capture.capture import CaptureSettings
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses import mapping, structure_from_motion
from nerf2real.scenes.poses.checks import certainty
from nerf2real.scenes.poses.film import continuity, readout, shutter
from nerf2real.scenes.poses.localisation import LocalisationError, load
from nerf2real.scenes.poses.matching import features
from nerf2real.scenes.poses.matching.features import FeatureSettings
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.structure_from_motion import localise
from nerf2real.scenes.poses.unit_frame import mean_up
from nerf2real.scenes.poses.work import SHARES, Mapped, Steps, prepare_work
from tests.scenes import synthetic_capture as synthetic

FEW = LocaliseSettings(features=FeatureSettings(few_num_features=800), attempts=1)


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
  """Ten pictures of a textured corner, localised once."""
  folder = tmp_path_factory.mktemp("corner")
  poses = synthetic.walk(10)
  synthetic.write_images(folder / "images", poses)
  reports = []
  result = localise(
    folder / "images", folder / "out", settings=FEW, progress=lambda f, t: reports.append((f, t))
  )
  return folder, poses, result, reports


def test_poses_against_truth(corner):
  _, truth, result, _ = corner
  assert result.registered_fraction == 1
  errors = fountain.pose_errors(result.world_from_camera, truth)
  assert errors.position_rmse < 0.001  # of a walk of 1.3 m
  assert errors.rotation_rmse < 0.05
  assert result.camera.fx == pytest.approx(280, rel=0.02)
  assert result.reprojection_error_px < 0.1  # patches are aligned
  assert result.strategy.startswith("exhaustive")


def test_what_is_out_of_a_films_line_is_left_out_and_told(corner, tmp_path, monkeypatch):
  folder = corner[0]
  names = [path.name for path in sorted((folder / "images").iterdir())]
  times = {name: 2.0 + 0.5 * k for k, name in enumerate(names)}

  def drop(model, database, times):
    for image in mapping.registered(model):
      if image.name in names[4:6]:
        model.deregister_frame(image.frame_id)
    return continuity.OutOfLine(frozenset(names[4:6]), frozenset())

  monkeypatch.setattr(continuity, "drop_out_of_line", drop)
  shutil.copytree(folder / "out" / "work", tmp_path / "work")
  localise(folder / "images", tmp_path, settings=FEW, times=times)
  result = load(tmp_path / "sfm")
  assert result.left_out == tuple(names[4:6])
  assert set(result.names) == set(names) - set(names[4:6])
  assert any("from 4.0 s to 4.5 s stand apart" in line for line in result.warnings)


def test_a_films_pictures_whose_places_hang_on_little_are_left_out(corner, tmp_path, monkeypatch):
  folder = corner[0]
  names = [path.name for path in sorted((folder / "images").iterdir())]
  deviations = certainty.turns

  def turns(model):
    found = deviations(model)
    weak = next(image for image in mapping.registered(model) if image.name == names[4])
    return found | {weak.image_id: 6.0 * np.median(list(found.values()))}

  monkeypatch.setattr(certainty, "turns", turns)
  shutil.copytree(folder / "out" / "work", tmp_path / "work")
  times = {name: 2.0 + 0.5 * k for k, name in enumerate(names)}
  result = localise(folder / "images", tmp_path, settings=FEW, times=times)
  assert result.left_out == (names[4],) and names[4] not in result.names
  assert any("at 4.0 s stand apart" in line for line in result.warnings)


def test_points_lie_on_the_planes_with_their_colours(corner):
  _, truth, result, _ = corner
  metric = Similarity.fit(result.world_from_camera[:, :3, 3], truth[:, :3, 3])
  points = metric.apply(result.points)
  distance = np.min(np.abs(points - [3, 3, 0]), axis=1)
  assert np.median(distance) < 0.02
  row = len(truth) // 2
  seen = points[distance < 0.02]
  colors = result.point_colors[distance < 0.02]
  camera = (np.linalg.inv(truth[row]) @ np.c_[seen, np.ones(len(seen))].T).T[:, :3]
  pixels = synthetic.CAMERA.project(camera)
  inside = (pixels > 2).all(1) & (pixels < [318, 238]).all(1)
  image = synthetic.render(truth[row])[..., ::-1]
  u, v = pixels[inside].astype(int).T
  assert np.median(np.abs(image[v, u].astype(int) - colors[inside])) < 30


def test_model_is_in_the_unit_frame(corner):
  _, _, result, _ = corner
  np.testing.assert_allclose(mean_up(result.world_from_camera), [0, 0, 1], atol=1e-9)
  assert np.abs(result.world_from_camera[:, :3, 3]).max() <= 1
  assert np.mean(np.abs(result.points).max(axis=1) <= 1) > 0.9


def test_load_returns_what_was_saved(corner):
  folder, _, result, _ = corner
  again = load(folder / "out" / "sfm")
  assert again.names == result.names
  assert again.strategy == result.strategy
  assert again.camera == result.camera
  np.testing.assert_allclose(again.world_from_camera, result.world_from_camera, atol=1e-12)
  assert len(again.points) == len(result.points)
  np.testing.assert_allclose(
    again.unit_from_source.translation, result.unit_from_source.translation
  )
  assert not list((folder / "out").glob("*partial*")) + list((folder / "out").glob(".*"))
  with pytest.raises(LocalisationError, match="holds no localisation"):
    load(folder)


def test_progress_rises_to_the_end(corner):
  fractions = [fraction for fraction, _ in corner[3]]
  assert len(fractions) > 4
  assert fractions == sorted(fractions)
  assert 0.9 <= fractions[-1] <= 1


def test_second_run_repeats_no_feature_and_no_match(corner, monkeypatch, capfd):
  folder, _, result, _ = corner

  def never(*_, **__):
    raise AssertionError("done before")

  monkeypatch.setattr(features.pycolmap, "extract_features", never)
  monkeypatch.setattr(features.pycolmap, "match_image_pairs", never)
  again = localise(folder / "images", folder / "out", settings=FEW)
  assert again.names == result.names
  assert capfd.readouterr() == ("", "")  # nothing of COLMAP's log


def test_guidance_finds_what_colmaps_finds_and_an_interruption_loses_none(
  corner, tmp_path, monkeypatch
):
  folder, _, _, _ = corner
  pairs, pycolmap = [(0, 1), (0, 5), (3, 7)], features.pycolmap
  ids = list(features.image_ids(folder / "out" / "work" / "database.db").values())

  def matches(name, *runs):
    """What the pairs have after runs of `match_pairs`, by the number that each matched."""
    database = tmp_path / name
    shutil.copy(folder / "out" / "work" / "database.db", database)
    with pycolmap.Database.open(str(database)) as db:
      db.clear_matches()
      db.clear_two_view_geometries()
    for guided, number in runs:
      how = dataclasses.replace(FEW.features, guided_matching=guided)
      assert features.match_pairs(database, pairs, settings=how, seed=0) == number
    with pycolmap.Database.open(str(database)) as db:
      found = [db.read_two_view_geometry(ids[i], ids[j]).inlier_matches for i, j in pairs]
    return [set(map(tuple, rows.tolist())) for rows in found]

  plain = matches("plain.db", (False, 3))
  ours = matches("ours.db", (True, 3))
  assert matches("late.db", (False, 3), (True, 0)) == ours
  assert matches("twice.db", (True, 3), (True, 0)) == ours
  real = pycolmap.match_image_pairs

  def guided(*arguments, matching_options, **named):
    matching_options.guided_matching = True
    real(*arguments, matching_options=matching_options, **named)

  monkeypatch.setattr(pycolmap, "match_image_pairs", guided)
  theirs = matches("theirs.db", (False, 3))
  for few, more, expected in zip(plain, ours, theirs, strict=True):
    assert len(few) < len(more)
    assert len(more & expected) > 0.95 * max(len(more), len(expected))


def test_pictures_that_show_little_are_searched_for_fainter_things(tmp_path):
  random = np.random.default_rng(0)
  spots = cv2.GaussianBlur(random.normal(0, 1, (240, 320)), (0, 0), 3)
  spots /= np.abs(spots).max()
  (tmp_path / "images").mkdir()
  for name, contrast in (("plain.png", 10.0), ("rich.png", 90.0)):
    cv2.imwrite(str(tmp_path / "images" / name), np.uint8(np.round(128 + contrast * spots)))

  def counts(**settings):
    database = tmp_path / f"{len(list(tmp_path.iterdir()))}.db"
    how = FeatureSettings(**settings)
    names = ["plain.png", "rich.png"]
    features.extract_features(database, tmp_path / "images", names, settings=how)
    assert list(features.image_ids(database)) == names
    with features.pycolmap.Database.open(str(database)) as db:
      assert len(db.read_all_cameras()) == 1
    return features.feature_counts(database)

  before, after = counts(faint_below=0), counts(faint_below=200)
  assert before[0] < 50 < 200 <= after[0] < 400
  assert before[1] == after[1] > 200


def test_an_interrupted_run_continues_with_one_camera(corner, tmp_path):
  folder, _, _, _ = corner
  names = [f"view_{row:03d}.png" for row in range(10)]
  database = tmp_path / "database.db"
  few = FeatureSettings(few_num_features=300)
  features.extract_features(database, folder / "images", names[:4], settings=few)
  features.extract_features(database, folder / "images", names, settings=few)
  assert list(features.image_ids(database)) == names
  with features.pycolmap.Database.open(str(database)) as db:
    assert len(db.read_all_cameras()) == 1
  assert (features.feature_counts(database) > 100).all()
  assert features.match_pairs(database, [(0, 1), (1, 2)], settings=few, seed=0) == 2
  assert features.match_pairs(database, [(0, 1), (1, 2), (0, 9)], settings=few, seed=0) == 1


def test_other_pictures_start_a_new_database(corner, tmp_path):
  folder, _, _, _ = corner
  names = ["view_000.png"]
  work = tmp_path / "work"

  def prepare(images, settings=FEW):
    return prepare_work(images, work, names, settings, None)

  database = prepare(folder / "images")
  database.touch()
  assert prepare(folder / "images").exists()
  other = tmp_path / "other"
  other.mkdir()
  cv2.imwrite(str(other / names[0]), np.zeros((9, 9, 3), np.uint8))
  assert not prepare(other).exists()


def test_transforms_keep_their_poses_and_get_points(tmp_path, capfd):
  poses = synthetic.walk(8)
  synthetic.write_transforms(tmp_path / "source", poses, synthetic.CAMERA)
  capture = read_capture(
    tmp_path / "source", tmp_path / "keyframes", settings=CaptureSettings(num_keyframes=8)
  )
  result = localise(tmp_path / "keyframes", tmp_path / "out", settings=FEW, known=capture.known)
  back = result.unit_from_source.inverse()
  np.testing.assert_allclose(back.apply_pose(result.world_from_camera), poses, atol=1e-9)
  assert result.camera == synthetic.CAMERA
  points = back.apply(result.points)
  assert len(points) > 100
  assert np.median(np.min(np.abs(points - [3, 3, 0]), axis=1)) < 0.01  # metres, as the source
  assert "known poses" in result.strategy
  assert capfd.readouterr() == ("", "")  # nothing of COLMAP's log


def test_colmap_source_keeps_poses_and_scale_and_its_points_are_seen(corner, tmp_path):
  folder, _, _, _ = corner
  first = load(folder / "out" / "sfm")  # a test above may have localised it again
  source = tmp_path / "source"
  source.mkdir()
  (source / "images").symlink_to(folder / "images")
  (source / "sparse").symlink_to(folder / "out" / "sfm")
  capture = read_capture(source, tmp_path / "keyframes", settings=CaptureSettings(num_keyframes=10))
  result = localise(tmp_path / "keyframes", tmp_path / "out", settings=FEW, known=capture.known)
  back = result.unit_from_source.inverse()
  np.testing.assert_allclose(
    back.apply_pose(result.world_from_camera), first.world_from_camera, atol=1e-9
  )
  assert len(result.points) > 0.8 * len(first.points)
  assert len(result.tracks.view) > 0.8 * len(first.tracks.view)
  assert result.point_colors.max() > 0
  assert result.reprojection_error_px < 1.2 * 0.196  # as detected: poses are kept


def test_pictures_without_a_match_keep_the_points_that_came(tmp_path):
  (tmp_path / "images").mkdir()
  names = [f"{number}.png" for number in range(8)]
  for name in names:
    grey = np.full((synthetic.CAMERA.height, synthetic.CAMERA.width, 3), 128, np.uint8)
    cv2.imwrite(str(tmp_path / "images" / name), grey)
  points = np.random.default_rng(0).uniform(0, 3, (50, 3))
  known = KnownPoses(
    kind="colmap",
    camera=synthetic.CAMERA,
    files=tuple(tmp_path / "images" / name for name in names),
    world_from_camera=synthetic.walk(8),
    points=points,
    point_colors=np.full((50, 3), 200, np.uint8),
    point_errors=np.full(50, 0.5),
  )
  result = localise(tmp_path / "images", tmp_path / "out", settings=FEW, known=known)
  found = result.unit_from_source.inverse().apply(result.points)
  order, expected = np.argsort(found[:, 0]), np.argsort(points[:, 0])
  np.testing.assert_allclose(found[order], points[expected], atol=1e-9)
  assert not len(result.tracks.view)
  assert (result.point_colors == 200).all() and result.reprojection_error_px == 0.5


def test_a_camera_that_only_turns_is_told_so(tmp_path):
  position = np.array([0.9, 0.9, 1.2])
  targets = [np.array([2.4 + 0.5 * s, 2.6 - 0.9 * s, 0.8]) for s in np.linspace(-0.5, 0.7, 8)]
  poses = np.stack([synthetic.look_at(position, target) for target in targets])
  synthetic.write_images(tmp_path / "images", poses)
  try:
    result = localise(tmp_path / "images", tmp_path / "out", settings=FEW)
  except LocalisationError as error:
    assert "hardly moved sideways" in str(error)
  else:
    assert any("Hardly any parallax" in line for line in result.warnings)


def test_walking_gives_no_parallax_warning(corner):
  assert not any("parallax" in line for line in corner[2].warnings)


def test_unrelated_pictures_are_told_so(tmp_path):
  folder = tmp_path / "images"
  folder.mkdir()
  for number in range(8):
    cv2.imwrite(str(folder / f"{number}.png"), synthetic.texture(100 + number, 160))
  with pytest.raises(LocalisationError, match=r"0 of 8 keyframes were localised") as error:
    localise(folder, tmp_path / "out", settings=FEW)
  assert "take pictures from places in between" in str(error.value)
  assert "\n" not in str(error.value)
  assert error.value.missing == {f"{number}.png" for number in range(8)}
  times = {f"{number}.png": float(number) for number in range(8)}
  with pytest.raises(LocalisationError, match="film slower"):
    localise(folder, tmp_path / "out", settings=FEW, times=times)
  assert not (tmp_path / "out" / "sfm").exists()


def test_refinement_falls_back_when_distortion_folds(corner, monkeypatch):
  folder, _, _, _ = corner
  model = mapping.pycolmap.Reconstruction(str(folder / "out" / "sfm"))
  faults = iter(["the test says so"])
  monkeypatch.setattr(mapping, "camera_fault", lambda _: next(faults, None))
  refined, lens = mapping.refine(model)
  assert lens.words == "focal lengths only, no distortion, because the test says so"
  np.testing.assert_array_equal(refined.cameras[1].params[4:], 0)


def test_a_picture_that_is_weak_without_the_shutter_has_no_place(corner, monkeypatch):
  model = pycolmap.Reconstruction(str(corner[0] / "out" / "sfm"))
  images = mapping.registered(model)
  for k, point in enumerate(images[3].points2D):
    if point.has_point3D():
      model.delete_observation(images[3].image_id, k)
  count = len(images)
  motion = shutter.Shutter(
    readout=0.5,  # as long as a frame of this film, which is told
    rotations=np.arange(count)[:, None] * np.ones(3),
    translations=np.zeros((count, 3)),
    depths=np.ones(count),
  )
  monkeypatch.setattr(readout, "take_out", lambda *args, **options: (model, motion))
  mapped = Mapped(model, "test", (), mapping.FreeLens(True, True, ""))
  times = {image.name: 0.5 * k for k, image in enumerate(images)}
  found = structure_from_motion._without_shutter(mapped, times, Steps(no_progress))
  assert found.model.num_reg_images() == count - 1
  assert found.shutter.rotations[:, 0].tolist() == [k for k in range(count) if k != 3]
  assert [text.partition(":")[0] for text in found.warnings] == ["Rolling shutter"]


def test_a_film_without_times_keeps_its_shutter(corner):
  model = pycolmap.Reconstruction(str(corner[0] / "out" / "sfm"))
  mapped = Mapped(model, "test", (), mapping.FreeLens(True, True, ""))
  times = {image.name: 0.0 for image in mapping.registered(model)}
  found = structure_from_motion._without_shutter(mapped, times, Steps(no_progress))
  assert found.model is model and found.shutter is None
  assert found.strategy == "test; rolling shutter not taken out, because the film has no times"


def test_a_film_of_which_few_keyframes_are_kept_keeps_its_shutter(corner):
  """Nothing tells how the phone moved: the readout had no equation, which ended the run."""
  model = pycolmap.Reconstruction(str(corner[0] / "out" / "sfm"))
  mapped = Mapped(model, "test", (), mapping.FreeLens(True, True, ""))
  times = {image.name: 2.5 * k for k, image in enumerate(mapping.registered(model))}
  assert not readout.tells_motion(model, times)
  found = structure_from_motion._without_shutter(mapped, times, Steps(no_progress))
  assert found.model is model and found.shutter is None
  assert "too far apart" in found.strategy and "Give more --keyframes" in found.warnings[0]


def test_figures_are_plain_json(corner):
  folder, _, result, _ = corner
  values = json.loads((folder / "out" / "sfm" / "localisation.json").read_text())
  assert values["registered_fraction"] == 1.0
  assert set(values["seconds"]) == set(SHARES) - {"holding", "shutter"}
  assert isinstance(result.camera, Camera)
