"""Tests of localisation: pairs, unit frame, and a small reconstruction against the truth."""

import dataclasses
import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.rooms import fountain
from nerf2real.core.cameras import Camera
from nerf2real.core.similarity import Similarity
from nerf2real.scenes.capture.capture import CaptureSettings, read_capture
from nerf2real.scenes.poses import localise as localise_module
from nerf2real.scenes.poses import mapping, matching
from nerf2real.scenes.poses.localise import LocalisationError, LocaliseSettings, load, localise
from nerf2real.scenes.poses.matching import FeatureSettings
from nerf2real.scenes.poses.pairs import (
  PairSettings,
  choose_pairs,
  exhaustive_pairs,
  loop_pairs,
  overlap_scores,
  repair_pairs,
  sequential_pairs,
  sparse_keyframes,
)
from nerf2real.scenes.poses.unit_frame import mean_up, unit_from_source
from tests.scenes import synthetic_capture as synthetic
from tests.scenes.capture.test_capture import write_transforms

FOUNTAIN = Path(__file__).parents[4] / "shared" / "data" / "captures" / "fountain-P11"
FEW = LocaliseSettings(features=FeatureSettings(few_num_features=800))


def components(count, pairs):
  """Number of connected components of an undirected graph, by union-find."""
  parent = list(range(count))

  def root(node):
    while parent[node] != node:
      node = parent[node]
    return node

  for a, b in pairs:
    parent[root(a)] = root(b)
  return len({root(node) for node in range(count)})


def scores_of_a_loop(keyframes, count):
  """Overlap of keyframes on two rounds through one room: near in phase means many matches."""
  phase = (keyframes[:, None] - keyframes[None]) % (count // 2)
  phase = np.minimum(phase, count // 2 - phase)
  return np.maximum(0, 60 - phase)


@pytest.mark.parametrize("count", [250, 500, 1000])
def test_pairs_grow_linearly_and_connect_everything(count):
  settings = PairSettings()
  pairs, words = choose_pairs(
    np.full(count, 2000), settings, score=lambda keyframes: scores_of_a_loop(keyframes, count)
  )
  assert "sequential" in words
  assert "loop closures" in words
  assert len(set(pairs)) == len(pairs)
  assert all(0 <= a < b < count for a, b in pairs)
  assert components(count, pairs) == 1
  most = count * (settings.overlap + 3) + settings.loop_keyframes * settings.loop_closures
  assert len(pairs) <= most
  assert len(pairs) < 0.25 * count * (count - 1) / 2 or count < 500
  second_round = [(a, b) for a, b in pairs if abs(b - a - count // 2) < 10]
  assert len(second_round) > 50  # the second round is tied to the first


def test_few_keyframes_are_matched_exhaustively():
  def never(_):
    raise AssertionError("no scores are needed")

  pairs, words = choose_pairs(np.full(30, 4000), PairSettings(), score=never)
  assert words.startswith("exhaustive")
  assert sorted(pairs) == list(itertools.combinations(range(30), 2))


def test_the_bound_is_the_cost_not_the_number():
  few = choose_pairs(np.full(150, 1000), PairSettings(), score=None)
  assert few[1].startswith("exhaustive")
  many = choose_pairs(
    np.full(150, 3000), PairSettings(), score=lambda k: np.zeros((len(k), len(k)), int)
  )
  assert many[1].startswith("sequential")


def test_sequential_pairs_by_hand():
  assert sorted(sequential_pairs(5, 1)) == [
    (0, 1),
    (0, 2),
    (0, 4),
    (1, 2),
    (1, 3),
    (2, 3),
    (2, 4),
    (3, 4),
  ]
  assert exhaustive_pairs(3) == [(0, 1), (0, 2), (1, 2)]
  np.testing.assert_array_equal(sparse_keyframes(10, 4), [0, 3, 6, 9])
  assert len(sparse_keyframes(1000, 300)) <= 300


def test_loop_pairs_by_hand():
  keyframes = np.array([0, 10, 20, 30])
  scores = np.array([[0, 9, 8, 2], [9, 0, 7, 6], [8, 7, 0, 5], [2, 6, 5, 0]])
  chosen = loop_pairs(keyframes, scores, min_distance=10, per_keyframe=1, min_score=3)
  assert chosen == [(0, 20), (10, 30)]


def test_repair_pairs_reach_the_whole_capture_and_stay_bounded():
  pairs = repair_pairs([100], 1000, overlap=10, loop_keyframes=300)
  others = {a + b - 100 for a, b in pairs}
  assert set(range(70, 131)) - {100} <= others
  assert min(others) < 10
  assert max(others) > 990
  assert len(repair_pairs(range(500), 1000, overlap=10, loop_keyframes=300)) < 1000 * 45


def test_overlap_scores_against_brute_force():
  generator = np.random.default_rng(0)
  base = generator.normal(size=(40, 16))
  descriptors = np.stack(
    [
      base[generator.permutation(40)[:20]] + 0.05 * generator.normal(size=(20, 16))
      for _ in range(5)
    ]
  ).astype(np.float32)
  descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True)
  descriptors[4, 12:] = 0
  scores = overlap_scores(descriptors, ratio=0.85)
  for i, j in itertools.permutations(range(5), 2):
    a, b = (i, j) if i > j else (j, i)
    first = descriptors[a][np.abs(descriptors[a]).sum(1) > 0]
    second = descriptors[b][np.abs(descriptors[b]).sum(1) > 0]
    forward = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher(cv2.NORM_L2).match(second, first)}
    expected = sum(
      m.distance < 0.85 * n.distance and back[m.trainIdx] == m.queryIdx for m, n in forward
    )
    assert abs(scores[i, j] - expected) <= (1 if 4 in (i, j) else 0)
  np.testing.assert_array_equal(scores, scores.T)


def test_unit_frame_is_upright_and_holds_points_and_cameras():
  generator = np.random.default_rng(1)
  turn = cv2.Rodrigues(np.array([0.7, -0.4, 1.1]))[0]
  move = Similarity(3.7, turn, np.array([5.0, -2.0, 9.0]))
  poses = synthetic.walk(20)
  points = generator.uniform([0, 0, 0], [3, 3, 3], (5000, 3))
  points[:50] *= 40  # outliers
  unit = unit_from_source(move.apply_pose(poses), move.apply(points))
  cameras = unit.apply_pose(move.apply_pose(poses))
  np.testing.assert_allclose(mean_up(cameras), [0, 0, 1], atol=1e-9)
  inside = np.abs(unit.apply(move.apply(points))).max(axis=1) <= 1
  assert 0.975 <= inside.mean() <= 1
  assert np.abs(cameras[:, :3, 3]).max() < 1
  # It does not depend on the source's frame.
  same_frame(unit @ move, unit_from_source(poses, points))


def same_frame(found, expected, *, tolerance=1e-8):
  assert found.scale == pytest.approx(expected.scale, rel=tolerance)
  np.testing.assert_allclose(found.rotation, expected.rotation, atol=tolerance)
  np.testing.assert_allclose(found.translation, expected.translation, atol=tolerance)


def square_rooms():
  """Points and poses whose box is as small in every quarter turn, in frames of all directions."""
  generator = np.random.default_rng(3)
  quarter = generator.uniform([-2, -2, 0], [2, 2, 2.5], (1000, 3))
  turns = [cv2.Rodrigues(np.array([0, 0, k * np.pi / 2]))[0] for k in range(4)]
  points = np.concatenate([quarter @ turn.T for turn in turns])
  for target in ([2, 0, 1.0], [2, 2, 1.0], [0.3, 1.9, 0.5]):  # along a wall, into a corner, else
    views = [synthetic.look_at(np.array([x, 0.1, 1.0]), np.array(target)) for x in (0, 0.3, 0.9)]
    yield np.stack(views), points


@pytest.mark.parametrize("seed", range(4))
def test_unit_frame_is_unique(seed):
  """Noise of a billionth, another order of the points and another source frame change nothing."""
  generator = np.random.default_rng(seed)
  for poses, points in square_rooms():
    expected = unit_from_source(poses, points)
    noise = 1e-9 * generator.standard_normal(points.shape)
    shaken = (points + noise)[generator.permutation(len(points))]
    same_frame(unit_from_source(poses, shaken), expected)
    turn = cv2.Rodrigues(generator.uniform(-3, 3, 3))[0]
    source = Similarity(generator.uniform(0.1, 9), turn, generator.uniform(-5, 5, 3))
    same_frame(unit_from_source(source.apply_pose(poses), source.apply(shaken)) @ source, expected)


def test_a_frame_found_again_in_its_own_frame_is_the_same():
  for poses, points in square_rooms():
    unit = unit_from_source(poses, points)
    again = unit_from_source(unit.apply_pose(poses), unit.apply(points))
    same_frame(again, Similarity(1.0, np.eye(3), np.zeros(3)))


def test_walls_end_up_along_the_axes():
  generator = np.random.default_rng(2)
  points = generator.uniform([-2.5, -2, 0], [2.5, 2, 2.5], (4000, 3))
  poses = np.stack(
    [synthetic.look_at(np.array([0.5, y, 1.0]), np.array([2, 1, 1.0])) for y in (0, 0.5)]
  )
  unit = unit_from_source(poses, points @ cv2.Rodrigues(np.array([0, 0, 0.6]))[0].T)
  extent = np.ptp(unit.apply(points @ cv2.Rodrigues(np.array([0, 0, 0.6]))[0].T), axis=0)
  assert sorted(extent / unit.scale) == pytest.approx([2.5, 4, 5], rel=0.03)


def test_mean_up_of_a_camera_that_rolls_over():
  poses = np.tile(np.eye(4), (40, 1, 1))
  angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
  poses[:, :3, :3] = [cv2.Rodrigues(np.array([0, 0, a]))[0] for a in angles]
  poses[:, 0, 3], poses[:, 1, 3] = np.cos(angles), np.sin(angles)
  assert abs(mean_up(poses)[2]) == pytest.approx(1)


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
  assert errors.position_rmse < 0.01  # of a walk of 1.3 m
  assert errors.rotation_rmse < 0.2
  assert result.camera.fx == pytest.approx(280, rel=0.02)
  assert result.reprojection_error_px < 1
  assert result.strategy.startswith("exhaustive")


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

  monkeypatch.setattr(matching.pycolmap, "extract_features", never)
  monkeypatch.setattr(matching.pycolmap, "match_image_pairs", never)
  again = localise(folder / "images", folder / "out", settings=FEW)
  assert again.names == result.names
  assert capfd.readouterr() == ("", "")  # nothing of COLMAP's log


def test_an_interrupted_run_continues_with_one_camera(corner, tmp_path):
  folder, _, _, _ = corner
  names = [f"view_{row:03d}.png" for row in range(10)]
  database = tmp_path / "database.db"
  features = FeatureSettings(few_num_features=300)
  matching.extract_features(database, folder / "images", names[:4], settings=features)
  matching.extract_features(database, folder / "images", names, settings=features)
  assert list(matching.image_ids(database)) == names
  with matching.pycolmap.Database.open(str(database)) as db:
    assert len(db.read_all_cameras()) == 1
  assert (matching.feature_counts(database) > 100).all()
  assert matching.match_pairs(database, [(0, 1), (1, 2)], settings=features, seed=0) == 2
  assert matching.match_pairs(database, [(0, 1), (1, 2), (0, 9)], settings=features, seed=0) == 1


def test_other_pictures_start_a_new_database(corner, tmp_path):
  folder, _, _, _ = corner
  names = ["view_000.png"]
  work = tmp_path / "work"

  def prepare(images, settings=FEW):
    return localise_module._prepare_work(images, work, names, settings, None)

  database = prepare(folder / "images")
  database.touch()
  assert prepare(folder / "images").exists()
  other = tmp_path / "other"
  other.mkdir()
  cv2.imwrite(str(other / names[0]), np.zeros((9, 9, 3), np.uint8))
  assert not prepare(other).exists()


def test_transforms_keep_their_poses_and_get_points(tmp_path, capfd):
  poses = synthetic.walk(8)
  write_transforms(tmp_path / "source", poses, synthetic.CAMERA)
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


def test_colmap_source_keeps_poses_points_and_scale(corner, tmp_path):
  folder, _, _, _ = corner
  first = load(folder / "out" / "sfm")  # a test above may have localised it again
  source = tmp_path / "source"
  source.mkdir()
  (source / "images").symlink_to(folder / "images")
  (source / "sparse").symlink_to(folder / "out" / "sfm")
  capture = read_capture(source, tmp_path / "keyframes", settings=CaptureSettings(num_keyframes=10))
  result = localise(tmp_path / "keyframes", tmp_path / "out", known=capture.known)
  back = result.unit_from_source.inverse()
  np.testing.assert_allclose(
    back.apply_pose(result.world_from_camera), first.world_from_camera, atol=1e-9
  )
  assert len(result.points) == len(first.points)
  assert result.reprojection_error_px == pytest.approx(first.reprojection_error_px, rel=0.2)


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
  assert "film slower" in str(error.value)
  assert "\n" not in str(error.value)
  assert not (tmp_path / "out" / "sfm").exists()


@pytest.mark.parametrize(
  ("change", "fault"),
  [
    ({}, None),
    ({"k1": 0.06, "k2": -0.09}, None),
    ({"k1": -0.9}, "folds"),
    ({"k2": -2.0}, "folds"),
    ({"cx": 200.0}, "principal point"),
    ({"fy": 330.0}, "differ"),
  ],
)
def test_absurd_lenses_are_recognised(change, fault):
  camera = dataclasses.replace(synthetic.CAMERA, **change)
  found = mapping.camera_fault(camera)
  assert found is None if fault is None else fault in found


def test_refinement_falls_back_when_distortion_folds(corner, monkeypatch):
  folder, _, _, _ = corner
  model = mapping.pycolmap.Reconstruction(str(folder / "out" / "sfm"))
  faults = iter(["the test says so"])
  monkeypatch.setattr(mapping, "camera_fault", lambda _: next(faults, None))
  refined, words = mapping.refine(model)
  assert words == "focal lengths only, no distortion, because the test says so"
  np.testing.assert_array_equal(refined.cameras[1].params[4:], 0)


def test_figures_are_plain_json(corner):
  folder, _, result, _ = corner
  values = json.loads((folder / "out" / "sfm" / "localisation.json").read_text())
  assert values["registered_fraction"] == 1.0
  assert set(values["seconds"]) == {"features", "matching", "mapping", "refining"}
  assert isinstance(result.camera, Camera)


def test_fountain():
  if not FOUNTAIN.is_dir():
    pytest.skip("needs ../shared/data/captures/fountain-P11")
  _, truth = fountain.read_truth(FOUNTAIN / "gt_dense_cameras")
  errors = fountain.pose_errors(
    Similarity(0.2, cv2.Rodrigues(np.ones(3))[0]).apply_pose(truth), truth
  )
  assert errors.position_rmse < 1e-9
  assert errors.rotation_rmse < 1e-6
