"""What shows a task: the video of a rollout and the viewer in the browser."""

import av
import numpy as np
import pytest
import viser
from PIL import Image

from nerf2real import suite
from nerf2real.suite.views.drivers import Random, Standing, Walking
from nerf2real.suite.views.rollout import run_episodes
from nerf2real.suite.views.task_viewer import TaskViewer, view_task
from nerf2real.suite.views.viewer_elements import bars
from tests.suite.synthetic import FlatRenderer, make_room


@pytest.fixture
def room(tmp_path, monkeypatch):
  made = make_room(tmp_path)
  load = suite.load

  def load_room(task, **options):
    return load(task, **{**options, "scene": made, "renderer": FlatRenderer(depth=1.0)})

  monkeypatch.setattr(suite, "load", load_room)
  return made


@pytest.mark.parametrize("task", suite.ALL_TASKS)
def test_rollout_writes_a_video_of_the_length_asked_for(task, room, tmp_path):
  path = tmp_path / "videos" / "out.mp4"
  run_episodes(task, video=path, seconds=1.0, driver=Random)
  frames = [f.to_ndarray(format="rgb24") for f in av.open(str(path)).decode(video=0)]
  assert len(frames) == 20
  height, width = frames[0].shape[:2]
  assert height == 404 and width > 2 * 480  # three pictures above a line of text
  robot_view = frames[10][20:340, 500:940].reshape(-1, 3)
  np.testing.assert_allclose(np.median(robot_view, axis=0), (40, 80, 120), atol=8)
  assert frames[10][:360, :480].std() > 10  # the third person sees something


def test_rollout_reports_how_episodes_ended(room):
  lines = run_episodes(seconds=6.0, driver=Random)
  assert lines and all("ended by fall" in line and "no success" in line for line in lines)


def test_viewer_shows_the_state_and_pushes(room):
  environment = suite.load("ball_push", random=0)
  server = viser.ViserServer(host="127.0.0.1", port=18_734, verbose=False)
  try:
    viewer = TaskViewer(environment, server)
    viewer._policy.value = "stand"
    viewer._start_push("left")
    before = environment.task.state
    for _ in range(8):
      viewer.step()
    after = environment.task.state
    left = (after.velocity @ before.aligned)[1]
    assert left > 0.05  # 8 N for 0.15 s
    torso = environment.physics.model.ptr.geom("op3/body_link_0").id
    np.testing.assert_allclose(
      viewer._geoms[torso].position, environment.physics.data.ptr.geom_xpos[torso]
    )
    assert "ball" in viewer._bars.content and "total" in viewer._bars.content
    assert (viewer._picture.image[::6, ::6] == (40, 80, 120)).all(-1).mean() > 0.5
  finally:
    server.stop()


@pytest.mark.parametrize("task", suite.ALL_TASKS)
def test_every_task_is_served_with_the_field_and_steps(task, room):
  viewer = view_task(task, drivers={"stand": Standing}, port=18_735)
  try:
    for _ in range(12):
      viewer.step()
    goals = getattr(viewer._environment.task, "goals", ())
    assert len(viewer._goals) == len(goals) and "0.30 s" in viewer._status.content
  finally:
    viewer.server.stop()


def test_bars_grow_to_their_side():
  page = bars({"turn": -1.5, "speed": 0.75})
  assert "left:0.0%;width:50.0%" in page and "left:50.0%;width:25.0%" in page


def test_the_walker_takes_the_next_goal(room):
  """Its goals follow each other, and its actions are those of the suite."""
  environment = suite.load("nerf_nav", random=3)
  environment.reset()
  task = environment.task
  driver = Walking(task)
  before = task.goal.copy()
  task.next_goal()
  assert not np.array_equal(task.goal, before) and not task.success
  action = driver.act({"gyroscope": np.zeros((5, 3)), "gravity": np.tile([0, 0, -1.0], (5, 1))})
  assert action.shape == (20,) and np.abs(action).max() <= 1


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_an_animation_has_half_the_frames_and_plays(suffix, room, tmp_path):
  path = tmp_path / f"out{suffix}"
  run_episodes("nerf_nav", video=path, seconds=0.5, driver=Random)
  with Image.open(path) as film:
    film.load()
    assert film.n_frames == 5 and film.info["duration"] == 100 and film.height == 202


def test_a_film_of_another_kind_is_refused(room, tmp_path):
  with pytest.raises(ValueError, match=r"expected one that ends in \.mp4"):
    run_episodes("nerf_nav", video=tmp_path / "out.avi", seconds=0.5)
