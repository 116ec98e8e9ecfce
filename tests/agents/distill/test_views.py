"""Pictures at drawn places, for the encoder."""

import contextlib
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from nerf2real import scenes
from nerf2real.agents.distill import relabelling, views
from nerf2real.agents.distill import teacher as teachers
from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.dmpo.specs import BALL, POSITION, Layout
from nerf2real.agents.environments.loading import in_scene, make_environment
from nerf2real.core.geometry import rotations
from tests.agents.distill.test_turned_heads import world as plain_world  # noqa: F401

COUNT = 24
NAME = "suite:ball_push?image_size=12x16&pushes=false&light=true"
DATA = Path(scenes.__file__).parent / "data"


@pytest.fixture(scope="module")
def world():
  """Task, layout and postures of a drawn light's environment with a ball."""
  environment = make_environment(NAME, seed=0)
  layout = Layout.of(environment)
  rows = [layout.flatten(environment.reset().observation).privileged]
  for _ in range(3):
    rows.append(layout.flatten(environment.step(np.zeros(20)).observation).privileged)
  yield task_of(environment), layout, np.array(rows)
  environment.close()


@pytest.fixture(scope="module")
def made(world):
  task, layout, postures = world
  return views.make_views(task, layout, postures, rng=np.random.default_rng(1), count=COUNT)


def test_views_are_spread_over_the_free_floor(world, made):
  task, _, _ = world
  assert made["image"].shape == (COUNT, 12, 16, 3) and made["pose"].shape == (COUNT, 3)
  assert task.scene.free_space.is_reachable(made["pose"][:, :2].astype(np.float64)).all()
  assert (np.ptp(made["pose"], axis=0) > [1.0, 1.0, 4.0]).all()
  assert len({picture.tobytes() for picture in made["image"]}) == COUNT


def test_the_ball_is_ahead_of_the_head_or_far_behind(made):
  distance = np.hypot(made["ball"][:, 0], made["ball"][:, 1])
  turn = np.arctan2(made["ball"][:, 1], made["ball"][:, 0]) - made["ball"][:, 2]
  aside = np.abs(np.arctan2(np.sin(turn), np.cos(turn)))
  ahead = aside < 0.61
  assert 0.3 * COUNT < ahead.sum() < COUNT
  assert (distance[ahead] < 2.51).all() and (distance[ahead] > 0.19).all()
  assert aside[~ahead] == pytest.approx(np.pi) and distance[~ahead] == pytest.approx(3.0)


def test_a_view_shows_its_own_place(world, made):
  """Rendered again from pose, ball and head, with the posture alone left open."""
  task, layout, postures = world
  errors, moved = [], []
  for view in range(COUNT):
    pose, ball = made["pose"][view].astype(np.float64), made["ball"][view].astype(np.float64)
    task.put_ball(views._ahead(pose, np.arctan2(ball[1], ball[0]), np.hypot(*ball[:2])))
    for place, kept in ((pose, errors), (pose + np.array([0.0, 0.0, 1.0]), moved)):
      seen = _seen(task, layout, postures[-1], place, made, view)
      kept.append(np.abs(seen - made["image"][view].astype(int)).mean())
  assert np.median(errors) < 0.5 * np.median(moved)


def _seen(task, layout, row, place, made, view):
  """The picture from a place x, y, yaw, with the head's pan of a view and the best of its tilts."""
  rotation = views._part(layout, row, "privileged/robot_rotation", 9).reshape(3, 3)
  position = views._part(layout, row, "privileged/robot_position", 3)
  joints = views._part(layout, row, "privileged/joint_positions", 20).astype(np.float64)
  joints[views._PAN] = made["ball"][view, 2]
  turned = views._turned_to(rotation, place[2])
  assert rotations.yaw_of(turned) == pytest.approx(
    np.arctan2(np.sin(place[2]), np.cos(place[2])), abs=1e-6
  )
  pictures = []
  for tilt in np.linspace(-0.79, -0.157, 12):
    joints[views._TILT] = tilt
    position[:2] = place[:2]
    pictures.append(task.picture_of(position=position, rotation=turned, joints=joints).astype(int))
  wanted = made["image"][view].astype(int)
  return min(pictures, key=lambda picture: np.abs(picture - wanted).mean())


def test_a_runs_views_are_made_once(world, tmp_path):
  _, layout, postures = world
  with contextlib.closing(make_environment(NAME, seed=1)) as environment:
    rng = np.random.default_rng(1)
    made = views.make_views(task_of(environment), layout, postures, rng=rng, count=COUNT)
  np.savez(tmp_path / "000000_0000000000000001_1.npz", privileged=postures)
  path = tmp_path / "views.npz"
  first = views.kept_views(path, [NAME], layout, tmp_path, seed=1, count=COUNT)
  assert all(np.array_equal(first[name], array) for name, array in made.items())
  again = views.kept_views(path, [], layout, tmp_path, seed=2, count=5)
  assert np.array_equal(again["image"], first["image"])


def test_views_are_of_several_reconstructions(world, made, tmp_path):
  """Half of them in the built-in room, half in a copy of it whose field is darker."""
  _, layout, postures = world
  np.savez(tmp_path / "000000_0000000000000001_1.npz", privileged=postures)
  names = [NAME, in_scene(NAME, _darker_copy(tmp_path / "other"))]
  done: list[float] = []
  found = views.kept_views(
    tmp_path / "v.npz",
    names,
    layout,
    tmp_path,
    seed=1,
    count=COUNT,
    report=lambda fraction, _: done.append(fraction),
  )
  assert np.allclose(done, np.arange(1, COUNT + 1) / COUNT)
  assert {len(array) for array in found.values()} == {COUNT}
  first, second = found["image"].reshape(2, -1).mean(axis=1)
  assert second < 0.5 * first


def _darker_copy(folder):
  shutil.copytree(DATA / "room", folder)
  path = folder / "field.safetensors"
  with safe_open(path, "np") as stored:
    tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    metadata = stored.metadata()
  tensors["view_b2"] = tensors["view_b2"] - 2.0
  save_file(tensors, path, metadata)
  return folder


def test_a_batch_holds_frames_and_views(made):
  frames = {"image": np.zeros((3, 12, 16, 3), np.uint8), "state": np.zeros((3, 7))}
  frames |= {"pose": np.zeros((3, 3), np.float32), "ball": np.zeros((3, 3), np.float32)}
  batch = views.mixed(frames, made, np.array([4, 4]))
  assert set(batch) == {"image", "pose", "ball"} and len(batch["image"]) == 5
  assert np.array_equal(batch["pose"][3:], made["pose"][[4, 4]]) and not batch["pose"][:3].any()


def _headings(poses):
  return np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)


def test_episodes_labelled_anew_are_seen_in_a_drawn_light(plain_world, world, tmp_path):  # noqa: F811
  plain, layout, episode = plain_world
  task, _, _ = world
  source, found, rows = tmp_path / "source", {}, episode["privileged"].copy()
  robot, ball = (layout.privileged_column(name) for name in (POSITION, BALL))
  rows[:, ball : ball + 2] = rows[:, robot : robot + 2] + 0.5 * _headings(episode["pose"])
  episode = {**episode, "privileged": rows}
  source.mkdir()
  np.savez(source / "000000_0000000000000001_1.npz", **episode)
  for name, used in (("fixed", plain), ("drawn", task)):
    (tmp_path / name).mkdir()
    teacher = teachers.make_teacher("ball", used.scene)
    relabelling.relabel(source, tmp_path / name, layout=layout, teacher=teacher, task=used)
    with np.load(next((tmp_path / name).glob("*.npz"))) as stored:
      found[name] = {key: stored[key] for key in ("image", "label")}
  assert found["drawn"]["label"] == pytest.approx(found["fixed"]["label"])
  assert not np.array_equal(found["drawn"]["image"], found["fixed"]["image"])
