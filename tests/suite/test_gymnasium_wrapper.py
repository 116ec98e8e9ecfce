"""Gymnasium's own checker passes, and the wrapper's numbers are the suite's."""

import warnings

import numpy as np
import pytest

from nerf2real import suite
from nerf2real.suite.gymnasium_wrapper import GymnasiumEnv, register
from tests.suite.synthetic import FlatRenderer, make_room

gymnasium = pytest.importorskip("gymnasium")


@pytest.fixture
def load(tmp_path):
  room = make_room(tmp_path)

  def make(**options):
    return suite.load("nerf_nav", scene=room, renderer=FlatRenderer(depth=1.0), **options)

  return make


def test_its_own_checker_passes(load):
  from gymnasium.utils.env_checker import check_env

  with warnings.catch_warnings():
    warnings.simplefilter("error")
    # Readings without bounds are what they are: rates and forces are not normalised.
    warnings.filterwarnings("ignore", message=".*(infinity|unbounded|inf).*")
    warnings.filterwarnings("ignore", message=".*env.spec.*")
    check_env(GymnasiumEnv(load()), skip_render_check=True)


def test_same_numbers_as_the_suite(load):
  wrapped, own = GymnasiumEnv(load()), load(random=5)
  found, _ = wrapped.reset(seed=5)
  expected = own.reset().observation
  assert set(found) == {name for name in expected if not name.startswith("privileged/")}
  for action in np.random.default_rng(0).uniform(-1, 1, (3, 20)).astype(np.float32):
    found, reward, terminated, truncated, info = wrapped.step(action)
    timestep = own.step(action)
    for name, value in found.items():
      np.testing.assert_array_equal(value, timestep.observation[name])
    assert reward == timestep.reward and not terminated and not truncated
    assert info["reward_terms"].keys() == own.task.reward_terms.keys()


def test_failing_terminates_and_time_truncates(load):
  fallen = GymnasiumEnv(load())
  fallen.reset(seed=0)
  terminated = truncated = False
  while not (terminated or truncated):
    *_, terminated, truncated, info = fallen.step(np.ones(20, np.float32))
  assert terminated and not truncated and info["ending"] in ("fall", "collision")
  short = GymnasiumEnv(load(time_limit=0.05))
  short.reset(seed=0)
  standing = short.environment.task.standing_action
  short.step(standing)
  *_, terminated, truncated, info = short.step(standing)
  assert truncated and not terminated and info["ending"] == "time limit"


def test_what_is_called_outside_of_an_episode_says_so(load):
  short = GymnasiumEnv(load(time_limit=0.025), render_mode="rgb_array")
  standing = short.environment.task.standing_action
  with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
    short.render()
  with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
    short.step(standing)
  short.reset(seed=0)
  assert short.step(standing)[3]
  with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
    short.step(standing)
  assert short.render().shape == (240, 320, 3)  # what the episode ended with
  short.close()
  short.close()


def test_registered_tasks_are_known_to_both():
  class Other:
    pass

  suite.register_task("test_other", Other, time_limit=1.0)
  register()
  register()
  assert "nerf2real/test_other-v0" in gymnasium.registry
  assert suite.known_tasks()[:2] == suite.ALL_TASKS and "test_other" in suite.known_tasks()
  with pytest.raises(ValueError, match="one of the suite's own tasks"):
    suite.register_task("nerf_nav", Other)
  suite.register_task("test_endless", "collections:OrderedDict")
  with pytest.raises(ValueError, match="no length of its episodes"):
    suite.load("test_endless")
  with pytest.raises(ValueError, match="Unknown task 'none'.*'test_other'"):
    suite.load("none")
