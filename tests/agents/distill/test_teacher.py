"""The teachers: labels that follow the robot, settings by name, exported policies."""

import numpy as np
import pytest

from nerf2real import suite
from nerf2real.agents.distill import teacher as teachers
from nerf2real.agents.distill.learning import student
from nerf2real.agents.dmpo.policy import export
from nerf2real.agents.dmpo.specs import POSITION, ROTATION
from nerf2real.core.serialization import to_plain
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import RandomisationSettings
from tests.agents.distill.test_student import LAYOUT, TINY, make_state


@pytest.fixture(scope="module")
def environment():
  found = suite.load(
    "nerf_nav",
    scene=EmptyFloor(),
    image_size=None,
    random=0,
    time_limit=6.0,
    randomisation=RandomisationSettings(pushes=False),
  )
  found.task.set_start(Pose(0.0, 0.0, 0.0))
  return found


def _pose(task):
  return Pose(float(task.state.position[0]), float(task.state.position[1]), task.state.yaw)


def _walk(environment, teacher, *, noise, steps):
  """Lets a teacher drive with noise on its actions; returns the seconds on its feet."""
  rng = np.random.default_rng(0)
  timestep = environment.reset()
  task = environment.task
  teacher.reset(_pose(task))
  for step in range(steps):
    label = teacher.label(timestep.observation, goal=task.goal, pose=_pose(task))
    disturbed = label.action + noise * rng.standard_normal(20)
    timestep = environment.step(np.clip(disturbed, -1, 1))
    if timestep.last():
      return step
  return steps


def test_labels_agree_with_an_undisturbed_walker_after_following(environment):
  """A twin that was disturbed and one that was not see the same robot: the same labels."""
  task, rng = environment.task, np.random.default_rng(1)
  driver, twin = (teachers.make_teacher("quick", task.scene) for _ in range(2))
  timestep = environment.reset()
  for each in (driver, twin):
    each.reset(_pose(task))
  apart = []
  for step in range(160):
    labels = []
    for each in (driver, twin):
      observation = dict(timestep.observation)
      if each is twin and step < 60:  # the twin is shown controls that nobody applied
        control = np.array(observation["previous_control"])
        control[-1] = np.clip(control[-1] + 0.2 * rng.standard_normal(20), -1, 1)
        observation["previous_control"] = control
      labels.append(each.label(observation, goal=task.goal, pose=_pose(task)))
    apart.append(np.abs(labels[0].action - labels[1].action).mean())
    timestep = environment.step(labels[0].action)
    assert not timestep.last()
  assert np.mean(apart[20:60]) > 0.1
  assert np.mean(apart[-20:]) < 0.02
  assert labels[0].command == pytest.approx(labels[1].command, abs=1e-6)


def test_a_label_says_the_command_and_stays_within_the_actions(environment):
  teacher = teachers.make_teacher("steady", environment.task.scene)
  timestep = environment.reset()
  teacher.reset(Pose(0.0, 0.0, 0.0))
  ahead = teacher.label(timestep.observation, goal=np.array([2.0, 0.0]), pose=Pose(0.0, 0.0, 0.0))
  aside = teacher.label(timestep.observation, goal=np.array([2.0, 0.0]), pose=Pose(0.0, 0.0, 1.5))
  assert ahead.command[0] > 0.8 and abs(ahead.command[1]) < 0.1
  assert aside.command == pytest.approx([0.0, -1.0])
  for label in (ahead, aside):
    assert label.action.shape == (20,) and np.abs(label.action).max() <= 1


@pytest.mark.parametrize("name", ["quick", "tall"])
def test_a_teacher_walks_under_noise(environment, name):
  teacher = teachers.make_teacher(name, environment.task.scene)
  assert _walk(environment, teacher, noise=0.05, steps=200) == 200


def test_an_exported_policy_is_a_teacher_without_commands(tmp_path):
  _, state = make_state()
  arrays = student.served_parameters(state.student, state.scales)
  settings = to_plain(TINY.agent)
  export.export_policy(
    tmp_path, arrays, layout=LAYOUT, environment="suite:nerf_nav", settings=settings, info={}
  )
  teacher, policy = (
    teachers.make_teacher(str(tmp_path), None),
    export.load_policy(tmp_path).policy,
  )
  rng, carried = np.random.default_rng(0), policy.initial_state()
  teacher.reset(Pose(0.0, 0.0, 0.0))
  for _ in range(3):
    observation = {
      "camera": rng.integers(0, 256, (12, 16, 3), np.uint8),
      "goal": rng.normal(size=2),
      "gyroscope": rng.normal(size=3),
      POSITION: np.zeros(3),
      ROTATION: np.eye(3),
    }
    flat = LAYOUT.flatten(observation)
    step = policy.step(flat.image, flat.state, carried)
    carried = step.state
    label = teacher.label(observation, goal=np.zeros(2), pose=Pose(0.0, 0.0, 0.0))
    assert label.action == pytest.approx(np.clip(step.mean, -1, 1), abs=1e-6)
    assert np.isnan(label.command).all()


def test_an_unknown_teacher_is_refused():
  with pytest.raises(
    ValueError, match="Unknown teacher 'slow': expected one of steady, tall, quick"
  ):
    teachers.make_teacher("slow", None)
