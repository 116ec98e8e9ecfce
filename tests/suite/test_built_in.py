"""Both tasks in the built-in room, with its own radiance field."""

import time

import numpy as np
import pytest

from nerf2real import suite
from nerf2real.suite import loading, protocols
from nerf2real.suite.tasks import catalogue


@pytest.fixture(scope="module")
def room():
  from nerf2real.scenes import bundle

  if not (bundle.BUILT_IN / "scene.json").is_file():
    pytest.skip("the built-in room is not in this checkout")
  return bundle.Bundle.load()


@pytest.fixture(scope="module")
def renderer(room):
  return loading.load_renderer(room)


@pytest.mark.parametrize("task", suite.ALL_TASKS)
def test_a_task_runs_in_the_built_in_room(task, room, renderer):
  environment = suite.load(task, scene=room, renderer=renderer, random=0)
  pictures = []
  for _ in range(4):
    observation = environment.reset().observation
    assert not environment.task.touches_scene
    pictures.append(observation["camera"])
    for _ in range(3):
      timestep = environment.step(environment.task.standing_action)
    assert not timestep.last()
  spread = [picture.std() for picture in pictures]
  assert min(spread) > 5  # a room, not a wall of fog
  assert not np.array_equal(pictures[0], pictures[1])


def test_a_reset_takes_less_than_20_ms(room):
  environment = suite.load("ball_push", scene=room, image_size=None, random=0)
  environment.reset()
  times = []
  for _ in range(15):
    begin = time.process_time()
    environment.reset()
    times.append(time.process_time() - begin)
  assert np.median(times) < 0.020


def test_start_places_are_clear_of_furniture(room):
  environment = suite.load("nerf_nav", scene=room, image_size=None, random=0)
  for _ in range(30):
    environment.reset()
    timestep = environment.step(environment.task.standing_action)
    assert environment.task.outcome.ending is None and not timestep.last()
    assert room.free_space.is_reachable(environment.task.state.position[None])[0]
  assert room.free_space.is_reachable(environment.task.goals).all()


@pytest.mark.parametrize("task", suite.ALL_TASKS)
@pytest.mark.parametrize("steps", [1_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_random_actions_give_no_warning_and_no_nan(task, steps, room):
  environment = suite.load(task, scene=room, random=5, image_size=None)
  rng = np.random.default_rng(5)
  environment.reset()
  endings = set()
  for _ in range(steps):
    timestep = environment.step(rng.uniform(-1, 1, 20))  # raises on a MuJoCo warning
    assert timestep.reward is None or np.isfinite(timestep.reward)
    assert all(np.isfinite(value).all() for value in timestep.observation.values())
    endings.add(environment.task.outcome.ending)
  assert not environment.physics.data.ptr.warning.number.any()
  assert "fall" in endings  # it did thrash about


@pytest.mark.parametrize("task", ["nerf_nav", "ball_push"])
def test_every_trial_of_the_protocols_can_start(task, room):
  environment = suite.load(task, scene=room, random=0, image_size=None)
  names = catalogue.PROTOCOLS[task]
  for trial in (trial for name in names for trial in protocols.PROTOCOLS[name]()):
    environment.task.set_trial(trial)
    environment.reset()
    environment.step(environment.task.standing_action)
    outcome = environment.task.outcome
    assert outcome.ending is None and not outcome.success, trial
    if task == "ball_push":  # here the furniture leaves the whole workspace of the paper free
      center = environment.task.workspace.center
      ball = environment.task.ball_position[:2] - center
      np.testing.assert_allclose(ball, trial.ball_xy, atol=1e-6)
      robot = environment.task.state.position[:2] - center
      np.testing.assert_allclose(robot, trial.robot_xy, atol=1e-3)
