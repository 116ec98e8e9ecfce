"""Recorded episodes whose head is turned to where a teacher has it."""

import numpy as np
import pytest

from nerf2real.agents.distill import relabelling, schedule, settings
from nerf2real.agents.distill import teacher as teachers
from nerf2real.agents.distill.collecting import episodes
from nerf2real.agents.distill.turned_heads import TILT, TurnedHead
from nerf2real.agents.dmpo.policy.acting import task_of
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.environments.loading import make_environment


@pytest.fixture(scope="module")
def world():
  """An environment with a ball, its layout, and an episode that the teacher `ball` drove."""
  name = "suite:ball_push?image_size=12x16&time_limit=1&pushes=false"
  environment = make_environment(name, seed=0)
  task, layout = task_of(environment), Layout.of(environment)
  runner = episodes.EpisodeRunner(
    environment,
    layout,
    teacher=teachers.make_teacher("ball", task.scene),
    settings=settings.MixtureSettings(detour_share=0.0, noisy_share=0.0),
    rng=np.random.default_rng(0),
  )
  episode, _ = runner.run(None, schedule.Mixture(1.0, 0.0))
  return task, layout, episode


def _columns(layout, name):
  """Columns [H, 20] of a history of joints in the flattened proprioception."""
  begin = sum(layout.state_sizes[: layout.state_names.index(name)])
  return begin + np.arange(100).reshape(5, 20)


def _true_tilt(layout, episode):
  return episode["privileged"][:, layout.privileged_column("privileged/joint_positions") + TILT]


def test_a_head_that_is_not_turned_sees_what_was_recorded(world):
  task, layout, episode = world
  head, errors, moved = TurnedHead(task, layout, episode), [], []
  for step in range(1, len(episode["state"])):
    head._angles[-1] = _true_tilt(layout, episode)[step - 1]
    seen = head.picture(step).astype(int)
    errors.append(np.abs(seen - episode["image"][step]).mean())
    moved.append(np.abs(seen - episode["image"][0]).mean())
  assert np.median(errors) < 0.3 * np.median(moved)  # what is left: the camera's delay and noise
  head._angles[-1] -= 0.4
  assert np.abs(head.picture(step).astype(int) - seen).mean() > 3 * np.median(errors)


def test_a_heads_tilt_follows_the_filtered_actions(world):
  task, layout, episode = world
  head = TurnedHead(task, layout, episode)
  action = np.zeros(20)
  action[TILT] = 0.5
  controls = [head._control]
  for _ in range(40):
    assert head.follow(action) == 0.5
    controls.append(head._control)
  assert controls[1] == pytest.approx(0.8 * controls[0] + 0.1)
  assert head._angles == pytest.approx(np.full(5, -0.4735 + 0.5 * 0.3165), abs=1e-3)
  observation = {"joint_positions": np.zeros((5, 20)), "previous_control": np.zeros((5, 20))}
  head.show(observation)
  assert observation["joint_positions"][:, TILT] == pytest.approx(head._angles)
  assert observation["previous_control"][-1, TILT] == pytest.approx(0.5, abs=1e-3)
  assert np.delete(observation["joint_positions"], TILT, axis=1).max() == 0


class _LooksUp:
  """Answers with the highest tilt, and with the legs as they were."""

  def __init__(self, episode):
    self._labels = iter(episode["label"])

  def reset(self, pose):
    pass

  def label(self, observation, *, goal, pose, ball=None):
    action = next(self._labels).copy()
    action[TILT] = 1.0
    return teachers.Label(action, np.zeros(2, np.float32))


def test_a_relabelled_episode_is_seen_by_the_head_of_the_teacher_of_now(world):
  task, layout, episode = world
  found = relabelling.relabelled(episode, layout, _LooksUp(episode), task=task)
  histories = ("joint_positions", "previous_control")
  own = np.concatenate([_columns(layout, name)[:, TILT] for name in histories])
  others = np.setdiff1d(np.arange(layout.state_size), own)
  assert np.array_equal(found["state"][:, others], episode["state"][:, others])
  tilt = found["state"][:, _columns(layout, "joint_positions")[-1, TILT]]
  assert tilt[0] < -0.3 and tilt[-1] == pytest.approx(-0.157, abs=0.01)
  assert (found["action"][:, TILT] == 1).all()
  rest = np.delete(np.arange(20), TILT)
  assert np.array_equal(found["action"][:, rest], episode["action"][:, rest])
  assert np.abs(found["image"][-1].astype(int) - episode["image"][-1]).mean() > 2
  for name in ("pose", "ball", "driver", "privileged", "reward"):
    assert np.array_equal(found[name], episode[name])
